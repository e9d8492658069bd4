"""The linear model about a pose, handed to python-control: poles, and a gain for the motors by LQR."""

import control
import numpy as np

from pcr_mpc import Plant, inverse_statics, linearise, load_robot, shipped

robot = load_robot(shipped("planar_pair", "robot"))
rest = inverse_statics(robot, (0.05, 0.27), mode="LR")
x = np.concatenate([rest.p, (0.0, 0.0), rest.q])  # [p, v, q]
plant = Plant(robot)
plant.reset(x, rest)

model = linearise(plant, x, u=(0.0, 0.0), dt=0.01)  # x+ = A x + B u + c
poles = np.linalg.eigvals(model.A)
frequencies = np.abs(np.log(poles[np.abs(poles.imag) > 1e-6])) / (2 * np.pi * 0.01)
print("natural frequencies [Hz]:", np.unique(frequencies.round(2)))

gain, _, closed = control.dlqr(model.to_control(), np.diag([1e4, 1e4, 1, 1, 1, 1]), np.eye(2))
print("slowest closed-loop pole:", np.abs(closed).max().round(3))
