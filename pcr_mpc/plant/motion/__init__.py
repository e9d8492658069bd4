"""The robot in motion: the plant, its integrators, a step as one graph, rollouts, distributed inertia.

Imports `statics`, `rods` and `robot`.
"""
