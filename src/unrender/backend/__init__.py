"""Mitsuba's variant, and what this machine must have to run it."""
