"""Linear models of the plant."""
