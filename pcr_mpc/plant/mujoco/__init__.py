"""The same robot in another engine.

Imports `motion`, `statics`, `rods` and `robot`.
"""
