"""Studies of the closed loop."""
