"""An equilibrium judged by the rod equation alone, integrated here once more."""

import math

import numpy as np
from scipy.integrate import DOP853

from pcr_mpc import Equilibrium

# Up to this lambda a rod is also integrated in one go from its base; errors grow like exp(lambda).
_MODERATE = 8.0
# Of theta, m/lambda, positions, forces: what the method's own discretisation leaves.
TOLERANCE = {"closed_form": 1e-7, "multiple_shooting": 1e-4, "single_shooting": 1e-4}


def integrate(start: np.ndarray, force: np.ndarray, length: float, load: float) -> np.ndarray:
    """theta' = m, m' = n_x sin(theta) - n_y cos(theta), x' = cos, y' = sin, U' = m^2/2, for many pieces at once.

    ``start`` (2, M) = [theta, m] and ``force`` (2, M) at the start of the pieces -> (5, M) [theta, m, dx, dy, U].
    """
    steps = max(2, math.ceil(load * length / 0.2))
    h = length / steps
    state = np.concatenate([start, np.zeros((3, start.shape[1]))])

    def slope(y):
        cos, sin = np.cos(y[0]), np.sin(y[0])
        return np.array([y[1], force[0] * sin - force[1] * cos, cos, sin, y[1] ** 2 / 2])

    for _ in range(steps):
        slopes = np.empty((DOP853.n_stages, *state.shape))
        for k in range(DOP853.n_stages):
            slopes[k] = slope(state + h * np.tensordot(DOP853.A[k, :k], slopes[:k], 1))
        state = state + h * np.tensordot(DOP853.B, slopes, 1)
    return state


def residuals(eq: Equilibrium) -> dict[str, float]:
    """What is wrong with an equilibrium, as numbers that should be far below 1e-3."""
    found: dict[str, float] = {}

    def note(name, value):
        found[name] = max(found.get(name, 0.0), float(np.max(np.abs(value))))

    robot, scale = eq.robot, 0.0
    for i, (rod, nodes) in enumerate(zip(robot.rods, eq.nodes, strict=True)):
        theta, n_x, n_y, m = nodes
        load = math.sqrt(math.hypot(n_x[0], n_y[0])) + 1.0
        scale += rod.bending_stiffness / rod.length**2 * load**2
        n_nodes = nodes.shape[1]
        unit = rod.bending_stiffness / rod.length**2
        note("clamp angle", theta[0] - eq.q[i])
        note("constant force", (nodes[1:3] - nodes[1:3, :1]) / load**2)
        note("rod force", (eq.rod_forces[i] - unit * nodes[1:3, 0]) / (unit * load**2))
        note("motor torque", (eq.motor_torque[i] + unit * rod.length * m[0]) / (unit * rod.length * load))
        ends = integrate(np.array([theta, m]), nodes[1:3], 1.0 / n_nodes, load)
        if n_nodes > 1:
            note("theta between nodes", ends[0, :-1] - theta[1:])
            note("moment between nodes", (ends[1, :-1] - m[1:]) / load)
        note("moment at the tip", ends[1, -1] / load)
        target = (eq.p - rod.base) / rod.length
        miss = ends[2:4].sum(axis=1) - target
        note("tip position", miss)
        note("tip position over slack", miss / (1.0 - np.hypot(*target)))
        found["energy"] = found.get("energy", 0.0) + ends[4].sum() * unit * rod.length
        if load - 1.0 <= _MODERATE:
            end = integrate(np.array([theta[:1], m[:1]]), nodes[1:3, :1], 1.0, load)[:, 0]
            note("tip position in one go", (end[2:4] - target) / math.exp(load - 1.0))
            note("moment at the tip in one go", end[1] / math.exp(load - 1.0))
    found["energy"] = abs(found["energy"] / eq.energy - 1.0) if eq.energy else found["energy"]
    note("force balance", (eq.rod_forces.sum(axis=0) - eq.force) / scale)
    note("symmetry of K", (eq.dforce_dp - eq.dforce_dp.T) / np.abs(eq.dforce_dp).max())
    return found
