"""The capture studio: a synthetic person, dressed, moved, lit and filmed with Mitsuba's path tracer into a capture like any other."""
