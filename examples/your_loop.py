"""The controller in a loop of one's own: start where the robot stands, step with what is measured; a sensor fails."""

import numpy as np

from pcr_mpc import Circle, Plant, Sensors, inverse_statics, load_robot, load_tuning, make_controller, shipped

robot = load_robot(shipped("planar_pair", "robot"))
path = Circle(centre=(0.0, 0.25), radius=0.03, period=3.0)
tuning = load_tuning(shipped("default", "tuning"))
controller = make_controller(robot, path, tuning, period=0.01, sensors=Sensors(tip_noise=2e-5))

# A simulated robot stands in for yours.
rest = inverse_statics(robot, (0.0, 0.22), mode="LR")
plant, x = Plant(robot, integrator="rk4", dt=0.01), np.concatenate([rest.p, (0.0, 0.0), rest.q])
plant.reset(x, rest)

noise = np.random.default_rng(0)
controller.start(x[:2], x[4:])
for k in range(300):
    tip = x[:2] + noise.normal(0.0, 2e-5, 2)
    if 100 <= k < 110:
        tip = None  # the camera sees nothing for a tenth of a second
    if k == 200:
        tip = tip + 0.1  # and once it sees something else
    decision = controller.step(tip=tip, angles=x[4:], time=0.01 * k)
    for event in decision.events:
        print(f"{0.01 * k:.2f} s: {event['kind']}: {event['message']}")
    error = np.hypot(*(x[:2] - controller.target[0]))  # [m]
    x = plant.step(x, decision.u)
print(f"off by {1e3 * error:.3f} mm at the end")
