"""The renderer port answered by Mitsuba 3."""
