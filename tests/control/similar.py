"""Dynamically similar robots, scenes and tunings: the same motion in other units of length, mass and time."""

from dataclasses import dataclass, replace

import numpy as np

from pcr_mpc.loop.references.trajectory import Lemniscate


@dataclass(frozen=True)
class Units:
    """What becomes of a metre, a kilogram and a second."""

    length: float
    mass: float
    time: float

    @property
    def force(self):
        return self.mass * self.length / self.time**2

    @property
    def stiffness(self):
        return self.force / self.length

    @property
    def torque(self):
        return self.force * self.length

    @property
    def speed(self):
        return self.length / self.time

    def state(self, n):
        return np.array([self.length] * 2 + [self.speed] * 2 + [1.0] * n)

    def robot(self, robot):
        rods = [
            replace(
                rod,
                base=tuple(self.length * x for x in rod.base),
                length=self.length * rod.length,
                bending_stiffness=self.torque * self.length * rod.bending_stiffness,
                line_density=self.mass / self.length * rod.line_density,
                curvature=tuple(kappa / self.length for kappa in rod.curvatures),
                axial_stiffness=self.force * rod.axial_stiffness,
            )
            for rod in robot.rods
        ]
        return replace(
            robot,
            rods=tuple(rods),
            tip_mass=self.mass * robot.tip_mass,
            drag=self.mass / self.time * robot.drag,
            rate_limit=robot.rate_limit / self.time,
            acceleration_limit=robot.acceleration_limit / self.time**2,
            torque_limit=self.torque * robot.torque_limit,
            gravity=tuple(self.speed / self.time * g for g in robot.gravity),
        )

    def tuning(self, tuning):
        observer = tuning.observer
        if observer is not None:
            observer = replace(
                observer,
                tip_noise=self.length * observer.tip_noise,
                force_noise=self.force * observer.force_noise,
                force_walk=self.force * observer.force_walk,
            )
        return replace(
            tuning,
            position_weight=tuning.position_weight / self.length**2,
            velocity_weight=tuning.velocity_weight / self.speed**2,
            input_weight=tuning.input_weight * self.time**2,
            pd=(tuning.pd[0], tuning.pd[1] * self.time),
            observer=observer,
            period=None if tuning.period is None else tuning.period * self.time,
        )

    def pose_limits(self, limits):
        def corner(at):
            return None if at is None else tuple(self.length * x for x in at)

        return replace(
            limits,
            torque=limits.torque and self.torque * limits.torque,
            tip_lower=corner(limits.tip_lower),
            tip_upper=corner(limits.tip_upper),
            stiffness=limits.stiffness and self.stiffness * limits.stiffness,
        )

    def scene(self, scene):
        """A scene that follows a lemniscate."""
        path = scene.trajectory
        assert isinstance(path, Lemniscate)
        return replace(
            scene,
            robot=self.robot(scene.robot),
            duration=self.time * scene.duration,
            start_tip=scene.start_tip and tuple(self.length * x for x in scene.start_tip),
            start_velocity=tuple(self.speed * v for v in scene.start_velocity),
            trajectory=replace(
                path,
                centre=tuple(self.length * x for x in path.centre),
                size=tuple(self.length * x for x in path.size),
                period=self.time * path.period,
                ramp=self.time * path.ramp,
            ),
            plant=replace(scene.plant, dt=self.time * scene.plant.dt),
            period=self.time * scene.period,
            own_period=scene.own_period and self.time * scene.own_period,
            tuning=self.tuning(scene.tuning),
            force=tuple(self.force * f for f in scene.force),
            tip_noise=self.length * scene.tip_noise,
            deadline=self.time * scene.deadline,
            pose_limits=self.pose_limits(scene.pose_limits),
        )
