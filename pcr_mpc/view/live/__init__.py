"""The robot behind the page: plant and controller in simulated time, what a user does to them, what is recorded.

Knows no page, no frames and no server: these import it.
"""
