"""The fastest motion between way-points, whose path is free."""
