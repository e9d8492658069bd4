"""A plant as the robot of a real loop, and a user who checks every rate that he is told."""

import numpy as np

from pcr_mpc import (
    Plant,
    inverse_statics,
)
from tests.conftest import MODELS

PERIOD = 0.01
SCENE = MODELS / "scenes" / "lemniscate.toml"


class Loop:
    """Plant and user: calls the controller when it is told to, holds the last rates, and checks every one of them."""

    def __init__(self, controller, centre, force=(0.0, 0.0), start=True):
        self.robot, self.controller, self.force = controller.robot, controller, force
        eq = inverse_statics(self.robot, centre.p, force, guess=centre)
        self.plant = Plant(self.robot, integrator="velocity_verlet", dt=1e-3)
        self.x = np.concatenate([eq.p, np.zeros(2), eq.q])
        self.plant.reset(self.x, eq)
        self.t, self.u, self.events, self.tips, self.targets = 0.0, np.zeros(self.robot.n_rods), [], [], []
        if start:
            controller.start(eq.p, eq.q)

    def call(self, tip="measured", angles="measured", time="now", **told):
        p = self.x[:2] if isinstance(tip, str) else tip
        q = self.x[4:] if isinstance(angles, str) else angles
        decision = self.controller.step(tip=p, angles=q, time=self.t if isinstance(time, str) else time, **told)
        self.check(decision.u)
        self.events += [event["kind"] for event in decision.events]
        return decision

    def check(self, u):
        lower, upper = self.robot.angle_limits.T
        assert np.isfinite(u).all()
        assert (np.abs(u) <= self.robot.rate_limit).all()
        assert (np.abs(u - self.u) <= self.robot.acceleration_limit * PERIOD + 1e-9).all()
        ahead = self.x[4:] + PERIOD * u
        assert (ahead >= np.minimum(lower, self.x[4:]) - 1e-9).all()
        assert (ahead <= np.maximum(upper, self.x[4:]) + 1e-9).all()
        self.u = u.copy()

    def wait(self, steps=10):
        for _ in range(steps):
            self.x = self.plant.step(self.x, self.u, self.force)
            self.t = round(self.t + 1e-3, 9)
            self.tips.append(self.x[:2])

    def run(self, periods, **told):
        for _ in range(periods):
            self.call(**told)
            self.targets.append(self.controller.target)
            self.wait()
        return self

    def error(self, path, last, shift=0.0):
        """Largest distance from a path in the last so many steps [mm]."""
        t = self.t + 1e-3 * (np.arange(-last, 0) + 1) - shift
        return 1e3 * np.hypot(*(np.array(self.tips[-last:]) - path(t)[:, 0]).T).max()

    def smooth(self):
        """Largest change of the target's velocity and acceleration from one period to the next."""
        targets = np.array(self.targets)
        return [np.abs(np.diff(targets[:, i], axis=0)).max() for i in (1, 2)]
