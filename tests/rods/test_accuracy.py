"""F, K, G and torques of the closed form against an independent solution in extended precision."""

import numpy as np
import pytest

from pcr_mpc import solve_statics
from pcr_mpc.plant.rods.closed_form import elastica
from pcr_mpc.plant.rods.closed_form.chart import critical_load
from tests.conftest import random_pose

from . import taylor_rod


def nearly_folded(pair, rng):
    """A pose at which rod 0 carries 90 to 97 % of its limit, and a start on that branch; None if out of reach."""
    log_tip_angle = rng.uniform(-8.0, np.log(3.0))
    unknowns = np.array([log_tip_angle, rng.uniform(0.9, 0.97) * critical_load(log_tip_angle), rng.choice([-1.0, 1.0])])
    q = rng.uniform(-np.pi, np.pi, 2)
    tip = elastica.tip_map()(unknowns[:2])[0].full().ravel() * [1.0, unknowns[2]]
    cos, sin = np.cos(q[0]), np.sin(q[0])
    p = pair.bases[0] + pair.lengths[0] * np.array([cos * tip[0] - sin * tip[1], sin * tip[0] + cos * tip[1]])
    if (np.linalg.norm(p - pair.bases, axis=1) > 0.98 * pair.lengths).any():
        return None
    nodes = solve_statics(pair, p, q).nodes
    return p, q, np.stack([elastica.nodes(unknowns, q[0], nodes.shape[2]), nodes[1]])


def sweep(pair, count, seed):
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        if len(found) % 10 == 0:
            case = nearly_folded(pair, rng)
            if case is not None:
                found.append(solve_statics(pair, case[0], case[1], guess=case[2]))
            continue
        p, q = random_pose(pair, rng, 0.99)
        found.append(solve_statics(pair, p, q))
    return found


@pytest.mark.parametrize(
    ("count", "seed"),
    [(1000, 11), pytest.param(10_000, 12, marks=[pytest.mark.slow, pytest.mark.longest])],
    ids=["1000", "10000"],
)
def test_against_taylor_series(pair, count, seed):
    equilibria = sweep(pair, count, seed)
    newton, _ = elastica.rod_newton()
    starts, poses = np.empty((3, 2, len(equilibria))), np.empty((3, 2, len(equilibria)))
    for j, eq in enumerate(equilibria):
        for i, rod in enumerate(pair.rods):
            # The same division by the length as the library, so that both solve for the same pose.
            poses[:, i, j] = *((eq.p - rod.base) / rod.length), eq.q[i]
            start = elastica.from_nodes(eq.nodes[i])
            for _ in range(3):
                start += newton(start, poses[:, i, j])[0].full().ravel()
            starts[:, i, j] = start
    assert starts[1].max() > 150  # some rods are taut: the force is its square, in EI/L^2

    loads, tangents, change = taylor_rod.solve(*starts.reshape(3, -1), poses.reshape(3, -1))
    assert change.max() < 1e-8  # what is left is of the order of its square
    loads, tangents = loads.reshape(3, 2, -1), tangents.reshape(3, 3, 2, -1)
    force, moment = (pair.stiffnesses / pair.lengths**power for power in (2, 1))
    of_rods = {
        "force": np.einsum("kij,i->kij", loads[:2], force),
        "dforce_dp": np.einsum("klij,i->klij", tangents[:2, :2], force / pair.lengths),
        "dforce_dq": np.einsum("kij,i->kij", tangents[:2, 2], force),
        "motor_torque": np.einsum("ij,i->ij", -loads[2], moment),
        "dtorque_dq": np.einsum("ij,i->ij", -tangents[2, 2], moment),
    }
    for name, wanted in of_rods.items():
        # Relative to the rods' own: in balance their forces cancel.
        size = _largest(wanted)
        if name in ("force", "dforce_dp"):
            wanted = wanted.sum(axis=-2)
        found = np.moveaxis([getattr(eq, name) for eq in equilibria], 0, -1)
        error = _largest(found - wanted) / size
        assert error.max() < 1e-10, (name, equilibria[int(np.argmax(error))].p)
        assert np.median(error) < 1e-12, name


def _largest(values):
    return np.abs(values).reshape(-1, values.shape[-1]).max(axis=0)
