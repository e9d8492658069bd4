"""From recorded motion to the robot's numbers."""
