"""Search for a better tuning."""
