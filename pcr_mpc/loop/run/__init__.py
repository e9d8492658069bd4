"""The closed loop: a controller drives a plant; its record, limits and figures."""
