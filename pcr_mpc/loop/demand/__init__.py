"""What a reference asks of the robot: inverse dynamics along it, and whether the robot can."""
