"""Path tracers that return two states of a scene, and their adjoints by path replay."""
