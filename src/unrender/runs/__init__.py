"""The descent, its callbacks, and how a run is resumed."""
