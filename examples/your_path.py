"""A path of one's own: what it asks of the motors, by how much slower it would fit, and how it is tracked."""

from dataclasses import replace

import numpy as np

from pcr_mpc import Blended, PCRError, Spline, check_scene, load_scene, make_controller, shipped, simulate

points = [(0.0, 0.22), (0.04, 0.25), (0.0, 0.28), (-0.04, 0.25)]  # m
scene = load_scene(shipped("circle_from_file"))  # for its robot, plant and controller
for speed in (2.0, 0.4, 0.1):
    path = Blended(Spline(points, speed=speed, closed=True))
    wanted = replace(scene, trajectory=path, duration=np.ceil(path.duration / 0.01) * 0.01, start_tip=points[0])
    try:
        said = check_scene(wanted) or ["the robot can do it"]
    except PCRError as error:
        said = [str(error)]
    print(f"at {speed} m/s:", *said, sep="\n  ")

run = simulate(wanted, wanted.make_plant(), make_controller(wanted))
print(f"tracked within {run.summary()['max_mm']:.4f} mm")
