"""What leaving an effect out costs in tip error, before anything is simulated: orders of magnitude by simple formulas.

All rest on one picture: the tip is a mass m on springs K, and what is left out is a force dF on it, which displaces it
by K^-1 dF, the largest along the motion. A force that appears at once makes the tip swing to twice that.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ...errors import PCRError
from ...loop.hardware.motors import Motors
from ...loop.scene.scene import Scene
from ...loop.scene.settings import PlantSettings
from ...plant.motion.plant import Plant
from ...plant.rod import Rod
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.free_tip import inverse_statics
from ...plant.statics.held_tip import solve_statics
from .rungs import levels

_POSES = 9  # along the motion
_SUDDEN = 2.0  # swing of a spring from a force that appears at once, over its displacement at rest
# First frequency of a clamped-pinned beam, deflection of one under its weight and the pin's share of that weight, in
# sqrt(EI/(mu L^4)), w L^4/EI and w L (tables of beams).
_FREQUENCY, _SAG, _AT_PIN = 15.418, 1 / 185, 3 / 8
# Relative error of the frequency of a swing, over (omega dt)^order, and its order; of symplectic Euler the error is
# that of the velocity, half a step late.
_PHASE = {"velocity_verlet": (1 / 24, 2), "rk4": (1 / 120, 4), "gauss": (1 / 720, 4)}
# Local truncation of a Runge-Kutta step along a rod, of a solution like sin(lambda s).
_ORDERS = {"rk4": (4, 1 / 120), "rk8": (8, 1 / 362880)}


@dataclass(frozen=True)
class Estimate:
    """Tip error [m] and where it comes from."""

    error: float
    reason: str


class Estimates:
    """A-priori estimates for a scene, from its start, its path and its robot.

    Parameters
    ----------
    scene : Scene
    pose : Equilibrium
        In which it starts.

    Attributes
    ----------
    slowest, fastest : float
        Frequencies of the tip on the rods' stiffness, least and greatest along the motion [rad/s].
    """

    def __init__(self, scene: Scene, pose: Equilibrium) -> None:
        self._scene = scene
        robot, mass = scene.robot, scene.robot.tip_mass
        speed = float(np.linalg.norm(scene.start_velocity))
        self._free = scene.trajectory is None
        self._speed = 0.0  # of the tip, as the motors move it
        k = np.linalg.eigvalsh(pose.dforce_dp)
        path = [pose]
        if scene.trajectory is None:
            # It swings to v/omega, to either side.
            reach = np.array(scene.start_velocity) * math.sqrt(mass / k[0])
            for side in (reach, -reach):
                path.append(solve_statics(robot, pose.p + side, pose.q, guess=pose))
        else:
            samples = scene.trajectory(np.linspace(0.0, scene.duration, _POSES))
            for p in samples[1:, 0]:
                path.append(inverse_statics(robot, p, guess=path[-1]))
            fine = scene.trajectory(np.arange(0.0, scene.duration, scene.period))
            self._acceleration = float(np.linalg.norm(fine[:, 2], axis=1).max())
            self._speed = float(np.linalg.norm(fine[:, 1], axis=1).max())
        stiffnesses = np.array([np.linalg.eigvalsh(eq.dforce_dp) for eq in path])
        self._k = float(max(stiffnesses[:, 0].min(), 1e-9 * k[1]))
        self.slowest, self.fastest = math.sqrt(self._k / mass), math.sqrt(float(stiffnesses.max()) / mass)
        if self._free:
            self._acceleration = self.slowest * speed
        # A wrong frequency of a free swing grows into a wrong phase, half of omega T times the relative error of m.
        self._gain = max(1.0, self.slowest * scene.duration / 2) if self._free else _SUDDEN
        self._path = path
        self._masses = self._rods_masses()

    def of(self, rung: PlantSettings) -> dict[str, Estimate]:
        """Estimates of everything that a rung leaves out, by the name of the effect."""
        found: dict[str, Estimate] = {}
        for ladder, level in levels(rung).items():
            found |= self.of_level(ladder, level)
        return found

    def total(self, rung: PlantSettings) -> float:
        """Sum of the estimates of what a rung's physics leaves out [m]."""
        return sum(estimate.error for estimate in self.of(rung).values())

    def step(self, integrator: str, dt: float) -> Estimate:
        """Of an integrator's time step [s]: omega dt to the power of its order, on what swings, A = a/omega^2."""
        omega, swing = self.slowest, self._acceleration / self.slowest**2
        if self.fastest * dt > 2.0 and integrator != "gauss":
            return Estimate(math.inf, f"omega dt = {self.fastest * dt:.2g}: beyond the limit of stability")
        if integrator == "semi_implicit_euler":
            return Estimate(swing * omega * dt / 2, f"A omega dt/2, omega dt = {omega * dt:.2g}")
        factor, order = _PHASE[integrator]
        error = swing * omega * self._scene.duration * factor * (omega * dt) ** order
        return Estimate(error, f"A omega T (omega dt)^{order} {factor:.2g}, omega dt = {omega * dt:.2g}")

    def rods(self, rung: PlantSettings) -> Estimate:
        """Of the rods' discretisation: the local error of lambda h per step, lambda = L sqrt(n/EI), on their forces."""
        if rung.method == "closed_form":
            return Estimate(0.0, "exact")
        order, factor = _ORDERS[rung.scheme]
        forces = self._rod_forces()
        loads = self._scene.robot.lengths * np.sqrt(forces / self._scene.robot.stiffnesses)
        h = 1.0 / (rung.segments * rung.steps)
        error = float((forces * factor * (loads * h) ** order).sum()) / self._k
        return Estimate(
            error, f"n (lambda h)^{order}/k, lambda = {loads.max():.2g}, h = 1/{rung.segments * rung.steps}"
        )

    def of_level(self, ladder: str, level: str) -> dict[str, Estimate]:
        """Estimates of what one level of a ladder leaves out, the highest level nothing."""
        scene, robot, k, a = self._scene, self._scene.robot, self._k, self._acceleration
        rods, gravity = robot.rods, float(np.linalg.norm(robot.gravity))
        if ladder == "inertia" and any(rod.line_density for rod in rods):
            added = self._masses
            changes = [mass - added[0] for mass in added]
            whole, change = (self._gain * a * self._give(masses) for masses in (added, changes))
            gram = 1e3 * float(max(np.linalg.norm(mass, 2) for mass in added))
            if level == "none":
                return {
                    "rods' inertia": Estimate(
                        whole, f"up to {gram:.2g} g of the rods move with it: {self._gain:.2g} K^-1 dM a"
                    )
                }
            if level == "constant":
                gram = 1e3 * float(max(np.linalg.norm(mass, 2) for mass in changes))
                return {
                    "change of inertia": Estimate(
                        change, f"by up to {gram:.2g} g along the way: {self._gain:.2g} K^-1 dM a"
                    )
                }
            if level == "condensed":
                ratio = self.slowest / min(_FREQUENCY * math.sqrt(_natural(rod)) for rod in rods)
                reason = f"their inertia's times (omega/omega_rod)^2, {ratio:.2g}^2"
                return {"rods' vibration": Estimate(whole * ratio**2, reason)}
        if ladder == "weight" and level != "exact" and gravity and any(rod.line_density for rod in rods):
            weights = [rod.line_density * rod.length * gravity for rod in rods]
            down = np.array(robot.gravity) / gravity
            error = _SUDDEN * _AT_PIN * sum(weights) * self._give([down] * len(self._path))
            if level == "none":
                return {"rods' weight": Estimate(error, f"3/8 of {sum(weights):.2g} N hang on the pin: 2 K^-1 dF")}
            # A sag changes the energy in second order only.
            sag = max(w * rod.length**2 / rod.bending_stiffness for w, rod in zip(weights, rods, strict=True)) * _SAG
            return {"rods' sag": Estimate(error * sag, f"by {sag:.2g} L: that share of what their weight costs")}
        if ladder == "rods" and level == "plain":
            return self._as_built()
        if ladder == "payload" and level == "ignored" and scene.payload is not None:
            mass = scene.payload.mass
            error = _SUDDEN * mass * (a + gravity) / k
            return {
                "payload": Estimate(error, f"{mass:g} kg are accelerated and lifted by nobody: 2 m (a + g)/k, least k")
            }
        if ladder == "motors" and level == "ideal" and scene.motors is not None:
            return self._motors(scene.motors)
        return {}

    def _motors(self, motors: Motors) -> dict[str, Estimate]:
        """Of motors that do what they are told at once: a tip that is not late, never in the play, always moved."""
        found = {}
        turned = [np.linalg.solve(eq.dforce_dp, eq.dforce_dq) for eq in self._path]
        if motors.time_constant:
            error = _SUDDEN * motors.time_constant * self._speed
            found["motor lag"] = Estimate(error, f"the tip comes T later: 2 T v, v up to {1e3 * self._speed:.2g} mm/s")
        if motors.backlash:
            error = _SUDDEN * motors.backlash / 2 * max(float(np.abs(way).sum(axis=1).max()) for way in turned)
            found["backlash"] = Estimate(error, f"{motors.backlash / 2:.2g} rad to either side: 2 K^-1 G dq")
        if motors.saturated:
            most, limit, error = 0.0, self._scene.robot.torque_limit, 0.0
            for eq, way in zip(self._path, turned, strict=True):
                torque = np.abs(eq.motor_torque)
                most = max(most, float(torque.max()))
                short = np.maximum(torque - limit, 0.0) / np.abs(eq.dtorque_dq)
                error = max(error, float(np.linalg.norm(way @ short)))
            found["torque limit"] = Estimate(
                error, f"up to {most:.2g} of {limit:.2g} N m are needed: K^-1 G dq, dq = dtau/(dtau/dq)"
            )
        return found

    def _as_built(self) -> dict[str, Estimate]:
        robot, forces = self._scene.robot, self._rod_forces()
        found = {}
        bends = [max(map(abs, rod.curvatures)) for rod in robot.rods]
        if any(bends):
            # A cantilever bent by kappa is off by kappa L^2/2 at its end, and 3 EI/L^3 pull it back.
            pulls = [1.5 * rod.bending_stiffness * bend / rod.length
                     for rod, bend in zip(robot.rods, bends, strict=True)]  # fmt: skip
            found["curvature at rest"] = Estimate(
                _SUDDEN * float(np.linalg.norm(pulls)) / self._k, f"rods pull with 3/2 EI kappa/L = {max(pulls):.2g} N"
            )
        shares = np.array([float(np.mean(np.abs(np.array(rod.stiffness_factors) - 1.0))) for rod in robot.rods])
        if shares.any():
            error = _SUDDEN * float((shares * forces).sum()) / self._k
            found["stiffness along the rods"] = Estimate(error, f"EI is off by {shares.max():.2g}, and so are forces")
        if any(rod.stretches for rod in robot.rods):
            longest = 0.0
            for eq in self._path:
                ways = (eq.p - robot.bases) / np.linalg.norm(eq.p - robot.bases, axis=1)[:, None]
                along = np.abs((ways * eq.rod_forces).sum(axis=1))
                longer = along * np.array([rod.length / rod.axial_stiffness for rod in robot.rods])
                longest = max(longest, float(np.linalg.norm(np.linalg.pinv(ways) @ longer)))
            found["stretch"] = Estimate(_SUDDEN * longest, "the tip goes with the rods' lengths, n L/EA: 2 J^-1 dL")
        return found

    def _rod_forces(self) -> np.ndarray:
        """Largest along the motion, shape (n,) [N]."""
        return np.asarray(np.max([np.linalg.norm(eq.rod_forces, axis=1) for eq in self._path], axis=0))

    def _give(self, forces: Sequence[np.ndarray]) -> float:
        """Largest |K^-1 force| along the motion, of vectors (2,) or matrices (2, 2), one for each pose."""
        moved = [np.linalg.solve(eq.dforce_dp, f) for eq, f in zip(self._path, forces, strict=True)]
        return float(max(np.linalg.norm(move, 2) for move in moved))

    def _rods_masses(self) -> list[np.ndarray]:
        """What the rods add to the tip's mass at each pose, each (2, 2) [kg].

        Motors that keep the tip on its way turn by dq = -G^-1 K dp, and what they move is a part of it.
        """
        robot = self._scene.robot.weightless().plain()
        plant, found = Plant(robot, inertia="condensed"), []
        try:
            for i, eq in enumerate(self._path):
                x = np.concatenate([eq.p, [0.0, 0.0], eq.q])
                if i == 0:
                    plant.reset(x, eq)
                mass = plant.mass(eq.p, eq.q)[0]
                turning = 0.0 if self._free else mass[:2, 2:] @ np.linalg.pinv(eq.dforce_dq) @ eq.dforce_dp
                found.append(mass[:2, :2] - robot.tip_mass * np.eye(2) - turning)
        except PCRError:  # rods that are plain do not reach there: a third of each, as of one that turns about its base
            third = sum(rod.line_density * rod.length for rod in robot.rods) / 3
            found = [third * np.eye(2)] * len(self._path)
        return found


def _natural(rod: Rod) -> float:
    """EI/(mu L^4) [1/s^2]."""
    return rod.bending_stiffness / (rod.line_density * rod.length**4) if rod.line_density else math.inf
