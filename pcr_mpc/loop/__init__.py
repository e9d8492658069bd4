"""Scenes, closed-loop simulation and its record."""
