"""Controllers of a scene, and of a robot that follows a path."""
