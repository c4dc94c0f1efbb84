"""Renderers: the protocol that methods use, its Mitsuba implementation and analytic implementations in NumPy."""

AOVS = ("depth", "position", "sh_normal", "albedo", "mask")
"""Properties of the first visible surface that can be rendered in place of radiance, by the names of Mitsuba's `aov` integrator."""
