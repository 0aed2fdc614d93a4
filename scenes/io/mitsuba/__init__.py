"""Read Mitsuba scene files without a renderer; what has no counterpart is refused with its place."""
