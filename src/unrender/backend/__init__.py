"""Which Mitsuba variant runs, and what this machine needs for it."""
