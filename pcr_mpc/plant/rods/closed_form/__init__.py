"""The uniform, straight, weightless rod by elliptic functions: exact; and the chart of all its shapes.

Imports the equations, for nodes along a rod, and no other way to solve one.
"""
