"""A controller in somebody's own loop: measured times, references that change on the fly, sensors that fail."""
