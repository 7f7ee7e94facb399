"""Captures in the formats of other projects: read in place, converted into ours, and one of them written."""
