"""Studies of how the robot moves by itself."""
