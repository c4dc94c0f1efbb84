"""The result taken home: a scene folder that plain Mitsuba loads, and the recovered maps alone."""
