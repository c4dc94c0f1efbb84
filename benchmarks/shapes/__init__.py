"""Meshes as unknowns."""
