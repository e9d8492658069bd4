"""Laps of a reference, and what is learnt from one to the next."""
