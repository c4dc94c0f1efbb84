"""The run folder: its schema, its writer, its reader."""
