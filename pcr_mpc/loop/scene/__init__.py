"""Which robot does what, for how long, simulated how: scenes, their parts and their files."""
