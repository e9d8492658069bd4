"""Motions that show the robot's numbers."""
