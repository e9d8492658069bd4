"""Studies of poses: which there are, which are stable, where methods fail."""
