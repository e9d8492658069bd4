"""The robot: rods, statics and dynamics."""
