"""Renderers in NumPy with known integrals and derivatives."""
