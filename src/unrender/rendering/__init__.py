"""Renderers: the port that methods see, Mitsuba's answer, and an analytic one."""
