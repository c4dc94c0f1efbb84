"""Run folder: schema, writer, reader."""
