"""Optimisation in stages: the parameters that each stage optimises, and their initial values."""
