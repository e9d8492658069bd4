"""Studies of the loop: how long it takes, what physics a scene needs, robots that are not as believed, tuning."""
