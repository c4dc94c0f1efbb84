"""Renderers: the protocol that methods use, its Mitsuba implementation and analytic implementations in NumPy."""
