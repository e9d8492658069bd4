"""Rods with distributed mass in strain modes: theta_i(s) = q_i + int_0^s kappa0 + sum_j a_ij int_0^s P_j / f.

P_j are Legendre's polynomials on [0, 1], kappa0 is the rod's curvature at rest and f = EI(s)/EI. The modes are those
of the moment, which is smooth where kappa0 and f have knots; for a plain rod they are those of the curvature.
A rod cannot stretch, and its bending energy EI/L sum_jk a_j a_k int P_j P_k / f / 2 is quadratic, so that Lagrange's
equations need no penalty and converge spectrally in the number of modes. Lengths are in L, energies in EI/L, forces
in EI/L^2; what is left of the line density is beta = mu L^4 / EI [s^2], and of the weight w = mu g L^3 / EI. Along a
rod everything is taken at Gauss points between its knots: with S the matrix that integrates from the base,
c = cos(theta) and s = sin(theta), a point moves with

    r'' = S (-s theta'' - c theta'^2, c theta'' - s theta'^2),

and a mode takes part with dr/da_j = S (-s, c) Q_j, Q_j = int P_j / f. The sums below are the derivatives of this
discrete kinetic energy, not a discretisation of the derivatives: energy is what it should be to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.polynomial.legendre import leggauss, legvander

from ...errors import ModelError
from ..robot import Robot
from .equations import sample_rod, unpacked
from .physics import robot_physics

_SAMPLES = 129  # of a rod's curvature, from which its modes are fitted


@dataclass(frozen=True, eq=False)
class Blocks:
    """Derivatives of `StrainModes.inertia` with elastic and tip forces, for n rods of N modes.

    Attributes
    ----------
    mass, damping, stiffness : ndarray, shape (n, N, N)
        Of the equations of motion in a'', a' and a.
    jacobian : ndarray, shape (n, 2, N)
        Of the tip in a, and of its acceleration in a''.
    tip_damping, tip_stiffness : ndarray, shape (n, 2, N)
        Of the tip's acceleration in a' and a.
    """

    mass: np.ndarray
    damping: np.ndarray
    stiffness: np.ndarray
    jacobian: np.ndarray
    tip_damping: np.ndarray
    tip_stiffness: np.ndarray


class StrainModes:
    """The rods of a robot, each with N strain modes.

    Parameters
    ----------
    robot : Robot
    modes : int
        N, modes per rod.

    Attributes
    ----------
    beta : ndarray, shape (n, 1)
        mu L^4 / EI [s^2].
    elastic : ndarray, shape (n, N, N)
        Stiffness of the modes, int P_j P_k / f.
    weight : ndarray, shape (n, 2)
        w of each rod.

    Raises
    ------
    ModelError
        A rod stretches.
    """

    def __init__(self, robot: Robot, modes: int) -> None:
        if any(rod.stretches for rod in robot.rods):
            raise ModelError(
                f"strain modes (inertia 'full') are for rods that do not stretch, and a rod of {robot.name} does; "
                "take inertia 'condensed', or leave out axial_stiffness",
                key="axial_stiffness",
            )
        self.modes = modes
        density = np.array([rod.line_density for rod in robot.rods])
        self.beta = (density * robot.lengths**4 / robot.stiffnesses)[:, None]
        self._physics = robot_physics(robot)
        pieces = 1 if self._physics is None else max(1, self._physics[0].layout.intervals)
        s, self._weights, self._from_base = _gauss(modes, pieces)
        self._twice = self._from_base.T @ (self._weights[:, None] * self._from_base)
        self._beyond = self._weights @ self._from_base  # int r ds = sum of it times (c, s)
        curvatures, stiffnesses, self.weight = self._along(s, robot.n_rods)
        self._at_rest = curvatures @ self._from_base.T
        moments = legvander(2 * s - 1, modes - 1)
        curved = moments / stiffnesses[:, :, None]
        self._integrals = self._from_base @ curved  # (n, G, N)
        self._transposed = np.ascontiguousarray(np.swapaxes(self._integrals, 1, 2))
        self.elastic = moments.T @ (self._weights[:, None] * curved)

    def _along(self, s: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Curvature at rest and stiffness at s, shapes (n, G), and weight (n, 2), normalised."""
        curvatures, stiffnesses, weights = np.zeros((n, len(s))), np.ones((n, len(s))), np.zeros((n, 2))
        for i, physics in enumerate(self._physics or ()):
            weights[i], _, kappa, f = unpacked(physics.layout, physics.values)
            curvatures[i] = np.interp(s, np.linspace(0.0, 1.0, len(kappa)), kappa)
            if f is not None:
                stiffnesses[i] = np.interp(s, np.linspace(0.0, 1.0, len(f)), f)
        return curvatures, stiffnesses, weights

    def turned(self, a: np.ndarray, q: np.ndarray) -> np.ndarray:
        """By a' and q' theta' at the points, by a'' and q'' theta'', shape (..., n, G)."""
        return np.asarray(q[..., None] + (a[..., None, :] @ self._transposed)[..., 0, :])

    def angles(self, a: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Theta at the points, shape (..., n, G)."""
        return np.asarray(self._at_rest + self.turned(a, q))

    def elastic_moments(self, a: np.ndarray) -> np.ndarray:
        """What bending does on the modes, shape (..., n, N)."""
        return np.asarray((self.elastic @ a[..., None])[..., 0])

    def tips(self, a: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Tips relative to the bases, shape (n, 2)."""
        theta = self.angles(a, q)
        return np.stack([np.cos(theta) @ self._weights, np.sin(theta) @ self._weights], axis=-1)

    def tip_velocities(self, a: np.ndarray, a_dot: np.ndarray, q: np.ndarray, q_dot: np.ndarray) -> np.ndarray:
        """Velocities of the tips, shape (n, 2)."""
        theta, turning = self.angles(a, q), self.turned(a_dot, q_dot)
        return np.stack(
            [-(np.sin(theta) * turning) @ self._weights, (np.cos(theta) * turning) @ self._weights], axis=-1
        )

    def energies(
        self, a: np.ndarray, a_dot: np.ndarray, q: np.ndarray, q_dot: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Kinetic energy of each rod, and that of bending and weight, counted from its base; shapes (n,)."""
        theta, turning = self.angles(a, q), self.turned(a_dot, q_dot)
        x, y = (-np.sin(theta) * turning) @ self._from_base.T, (np.cos(theta) * turning) @ self._from_base.T
        centres = np.stack([np.cos(theta) @ self._beyond, np.sin(theta) @ self._beyond], axis=-1)
        potential = (a * self.elastic_moments(a)).sum(axis=-1) / 2 - (self.weight * centres).sum(axis=-1)
        return self.beta[:, 0] * ((x**2 + y**2) @ self._weights) / 2, potential

    def forces(
        self, theta: np.ndarray, turning: np.ndarray, turning_faster: np.ndarray, tip_forces: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Inertia of the modes less what weight and forces on the tips do on them, and the accelerations of the tips.

        Parameters
        ----------
        theta, turning, turning_faster : ndarray, shape (..., n, G)
            Theta, theta', theta'' at the points.
        tip_forces : ndarray, shape (..., n, 2)

        Returns
        -------
        on_modes : ndarray, shape (..., n, N)
        tip_accelerations : ndarray, shape (..., n, 2)
        """
        cos, sin = np.cos(theta), np.sin(theta)
        x, y = self._loads(cos, sin, turning, turning_faster, tip_forces)
        accelerations = _accelerations(cos, sin, turning, turning_faster)
        tips = np.stack([acceleration @ self._weights for acceleration in accelerations], axis=-1)
        return ((cos * y - sin * x)[..., None, :] @ self._integrals)[..., 0, :], tips

    def blocks(
        self, theta: np.ndarray, turning: np.ndarray, turning_faster: np.ndarray, tip_forces: np.ndarray
    ) -> Blocks:
        """Derivatives of `forces` and of the elastic moments; arguments as there, without leading axes."""
        cos, sin = np.cos(theta), np.sin(theta)
        x, y = self._loads(cos, sin, turning, turning_faster, tip_forces)
        modes, beta = self._integrals, self.beta[:, :, None]
        across = np.stack([-sin, cos])[..., None] * modes  # (2, n, G, N): dr/da before it is integrated
        along = np.stack([-cos, -sin])[..., None] * modes
        twice = np.swapaxes(across, 2, 3) @ self._twice  # (2, n, N, G)
        faster = along * turning_faster[..., None] - across * (turning**2)[..., None]
        slowing = 2.0 * along * turning[..., None]
        geometric = self._transposed @ ((-cos * x - sin * y)[..., None] * modes)
        weighted = self._weights[:, None]
        return Blocks(
            mass=beta * (twice @ across).sum(axis=0),
            damping=beta * (twice @ slowing).sum(axis=0),
            stiffness=geometric + beta * (twice @ faster).sum(axis=0) + self.elastic,
            jacobian=np.moveaxis((weighted * across).sum(axis=2), 0, 1),
            tip_damping=np.moveaxis((weighted * slowing).sum(axis=2), 0, 1),
            tip_stiffness=np.moveaxis((weighted * faster).sum(axis=2), 0, 1),
        )

    def fitted(self, nodes: np.ndarray) -> np.ndarray:
        """Modes near rods given by their nodes (n, 4, any), see `Equilibrium.nodes`; shape (n, N)."""
        s = np.linspace(0.0, 1.0, _SAMPLES)
        physics = self._physics or (None,) * len(nodes)
        moments = np.stack([sample_rod(rod, _SAMPLES, its)[5] for rod, its in zip(nodes, physics, strict=True)])
        fit = np.linalg.lstsq(legvander(2 * s - 1, self.modes - 1), moments.T, rcond=None)[0]
        return np.ascontiguousarray(fit.T)

    def _loads(
        self,
        cos: np.ndarray,
        sin: np.ndarray,
        turning: np.ndarray,
        turning_faster: np.ndarray,
        tip_forces: np.ndarray,
    ) -> list[np.ndarray]:
        """What each point has to carry beyond it, x and y: inertia less weight and force on the tip, weighted."""
        accelerations = _accelerations(cos, sin, turning, turning_faster)
        return [
            self.beta * (acceleration @ self._twice)
            - self.weight[:, k, None] * self._beyond
            - tip_forces[..., k, None] * self._weights
            for k, acceleration in enumerate(accelerations)
        ]


def _accelerations(
    cos: np.ndarray, sin: np.ndarray, turning: np.ndarray, turning_faster: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Second time derivative of (cos, sin)."""
    return -sin * turning_faster - cos * turning**2, cos * turning_faster - sin * turning**2


def _gauss(modes: int, pieces: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gauss points in equal pieces of a rod, weights, and the matrix that integrates from the base to each of them."""
    points = 2 * modes + 8 if pieces == 1 else -(-2 * modes // pieces) + 8
    x, w = leggauss(points)
    # Through the Legendre series of what is integrated.
    series = (2 * np.arange(points)[:, None] + 1) * legvander(x, points - 1).T * (w / 2)
    within = _integrals(x, points) @ series / pieces
    s = (np.arange(pieces)[:, None] + (1 + x) / 2).ravel() / pieces
    weights = np.tile(w / 2 / pieces, pieces)
    before = np.kron(np.tri(pieces, k=-1), np.ones((points, points))) * weights
    return s, weights, before + np.kron(np.eye(pieces), within)


def _integrals(x: np.ndarray, count: int) -> np.ndarray:
    """int_0^s P_j of the first Legendre polynomials on [0, 1] at s = (1 + x) / 2, shape (len(x), count)."""
    values = legvander(x, count)
    integrals = np.empty((len(x), count))
    integrals[:, 0] = (1 + x) / 2
    j = np.arange(1, count)
    integrals[:, 1:] = (values[:, 2:] - values[:, :-2]) / (2 * (2 * j + 1))
    return integrals
