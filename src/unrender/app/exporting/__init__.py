"""Export of results: a scene folder that plain Mitsuba loads, files for other programs, and the recovered maps alone."""
