"""One rod: equations, closed form, multiple shooting, the chart of its shapes, following a branch, snap, inertia.

Imports `robot` and what is below the plant.
"""
