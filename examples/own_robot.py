"""A robot of one's own, written down in Python: the motors that hold its tip, and what it feels like to pull at it."""

import numpy as np

from pcr_mpc import Robot, Rod, inverse_statics, solve_statics

rods = (
    Rod(base=(-0.15, 0.0), length=0.5, bending_stiffness=0.02, line_density=0.01, angle_limits=(1.0, 5.3)),
    Rod(base=(0.15, 0.0), length=0.5, bending_stiffness=0.02, line_density=0.01, angle_limits=(-2.1, 2.1)),
)
robot = Robot(
    name="mine", rods=rods, tip_mass=0.1, drag=0.1, rate_limit=6.0, acceleration_limit=300.0, torque_limit=1.0
)

rest = inverse_statics(robot, (0.0, 0.32), mode="LR")  # free tip at rest there, rods bowed outward
print(
    f"motor angles {np.degrees(rest.q).round(1)} deg, torques {rest.motor_torque.round(3)} N m, stable: {rest.stable}"
)

for pull in (0.001, 0.01, 0.03):
    held = solve_statics(robot, rest.p + (pull, 0.0), rest.q, guess=rest)
    print(f"{1e3 * pull:4.0f} mm to the right takes {held.force[0]:.3f} N; K = {held.dforce_dp[0, 0]:.1f} N/m")
