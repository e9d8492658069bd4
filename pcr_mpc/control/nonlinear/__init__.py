"""The yardstick: an MPC of the exact equations of motion, by Gauss collocation and IPOPT.

Imports the linear MPC, for its last resort; no linear law imports it.
"""
