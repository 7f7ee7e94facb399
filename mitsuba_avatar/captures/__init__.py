"""Captures: calibrated multi-view recordings of a person on disk, their reader, their writer, and checks."""
