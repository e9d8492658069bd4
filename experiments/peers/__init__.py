"""This project's controllers beside those of others, on the same problem."""
