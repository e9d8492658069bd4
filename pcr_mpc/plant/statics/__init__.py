"""All rods of a robot at once, at rest: equilibria with the tip held or free, their solvers and their stability.

Imports `rods` and `robot`.
"""
