"""A controller of one's own against the MPC, in the same closed loop."""

import numpy as np

from pcr_mpc import load_scene, make_controller, shipped, simulate


class Lever:
    """Turns the motors to where rods that are linear about the start would carry the tip to the path; damped."""

    def __init__(self, scene):
        self.path, self.period = scene.trajectory, scene.period

    def start(self, pose):
        """Where the robot stands: dq/dp there, from K and G."""
        self.pose, self.lever = pose, -np.linalg.pinv(pose.dforce_dq) @ pose.dforce_dp

    def step(self, k, x):
        """Motor rates [rad/s] of period k, from the measured state [p, v, q]."""
        p, v, _ = self.path(np.array([k * self.period]))[0]
        aim = p + 0.05 * (v - x[2:4])
        return 20.0 * (self.pose.q + self.lever @ (aim - self.pose.p) - x[4:])


scene = load_scene(shipped("lemniscate"))
for controller in (Lever(scene), make_controller(scene)):
    run = simulate(scene, scene.make_plant(), controller)
    print(f"{run.controller}: {run.summary()['rms_after_1s_mm']:.4f} mm RMS after 1 s")
