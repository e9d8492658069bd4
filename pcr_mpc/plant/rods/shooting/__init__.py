"""Any rod by multiple shooting: a Riccati sweep over its segments, and the inertia that goes with it.

Imports the equations, and no other way to solve a rod.
"""
