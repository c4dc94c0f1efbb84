"""Implementation of the renderer protocol with Mitsuba 3."""
