"""A hundred robots that are a little different, moved at once: how far apart they end, and which number does it."""

from dataclasses import replace

import numpy as np

from pcr_mpc import Plant, inverse_statics, load_robot, rollout, sensitivities, shipped

robot = load_robot(shipped("planar_pair", "robot"))
rest = inverse_statics(robot, (0.0, 0.25), mode="LR")
x0 = np.concatenate([rest.p, (0.0, 0.0), rest.q])
inputs = np.tile((0.5, -0.3), (300, 1))  # motor rates [rad/s], 0.3 s at 1 ms
plant = Plant(robot, integrator="velocity_verlet", dt=1e-3)

rng = np.random.default_rng(0)
robots = [
    replace(robot, tip_mass=robot.tip_mass * rng.normal(1.0, 0.05), drag=robot.drag * rng.uniform(0.5, 2.0))
    for _ in range(100)
]
ends = rollout(plant, x0, inputs, guess=rest, robots=robots).x[:, -1, :2]
print("spread of the tip after 0.3 s [mm]:", (1e3 * ends.std(axis=0)).round(3))

motion = sensitivities(plant, x0, inputs, guess=rest)
by_mass = motion.dx_dnumbers[-1, :2, motion.names.index("tip_mass")]
print("of 5 % of mass, by exact derivatives [mm]:", np.abs(1e3 * 0.05 * robot.tip_mass * by_mass).round(3))
