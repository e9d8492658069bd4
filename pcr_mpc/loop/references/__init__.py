"""Paths that the tip can be asked to follow, and how they are timed."""
