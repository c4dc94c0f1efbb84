"""Images of two states of a mesh."""
