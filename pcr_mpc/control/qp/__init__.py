"""The quadratic program of a linear MPC: condensing, its solvers behind one check, and which of them is asked.

Imports the limits of the motors and the tuning, and no law.
"""
