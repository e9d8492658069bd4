from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    Plant,
    UnreachableError,
    UnstableError,
    all_equilibria,
    assess_stability,
    distance_to_fold,
    inverse_statics,
    solve_statics,
)
from pcr_mpc.plant.rods.closed_form import elastica
from pcr_mpc.plant.rods.closed_form.chart import critical_load, stable_shapes
from pcr_mpc.plant.rods.equations import sample_rod
from pcr_mpc.plant.rods.shooting.multiple_shooting import rod_newton
from pcr_mpc.plant.statics.stability import count_conjugate_points
from tests.conftest import DATA, random_pose

LOGITS = (-5, -2, -1, 0, 1, 2, 3, 4, 5, 7, 10)


def test_critical_load_against_table():
    table = np.loadtxt(DATA / "lambda_c.csv", delimiter=",", skiprows=2)
    for logit, (_, limit) in zip(LOGITS, table, strict=True):
        k = 1 / (1 + np.exp(-logit))  # the table's k are these, rounded
        assert critical_load(np.log(2 * np.arccos(k))) == pytest.approx(limit, abs=1e-4 if limit < 10 else 1e-3)


def test_least_critical_load():
    k = np.linspace(0.93, 0.955, 26)
    limits = [critical_load(np.log(2 * np.arccos(value))) for value in k]
    assert min(limits) == pytest.approx(5.7659, abs=1e-3)
    assert k[np.argmin(limits)] == pytest.approx(0.9427, abs=2e-3)


def test_both_routes_agree_on_stable_and_unstable_rods(pair):
    """Elliptic functions against a sweep over the discretised rod equation, up to 1.6 lambda_c."""
    rng = np.random.default_rng(0)
    counted = {0: 0, 1: 0, 2: 0}
    for _ in range(300):
        rods = []
        for rod in pair.rods:
            # A rod of known shape at a random clamp angle, its tip brought to a common point by its base.
            log_tip_angle = np.log(rng.uniform(0.05, 3.0))
            load = critical_load(log_tip_angle) * rng.uniform(0.2, 1.6)
            rods.append((np.array([log_tip_angle, load, rng.choice([-1.0, 1.0])]), rng.uniform(-3, 3), rod))
        for unknowns, angle, _ in rods:
            count = elastica.conjugate_points(unknowns)
            nodes = elastica.nodes(unknowns, angle, 16)
            tip = sample_rod(nodes, 2)[:2, -1]
            swept = float(rod_newton(16, 2, "rk8")[0](nodes.ravel(order="F"), [*tip, angle])[4][3])
            # Within 1 % of the limit the sixteen nodes cannot tell.
            if abs(unknowns[1] / critical_load(unknowns[0]) - 1) > 0.01:
                assert swept == count, unknowns
                counted[min(count, 2)] += 1
    assert counted[0] > 100
    assert counted[1] > 50


def test_both_routes_agree_on_random_equilibria(pair):
    rng = np.random.default_rng(1)
    stable = unstable = 0
    for _ in range(60):
        p, q = random_pose(pair, rng, 0.95)
        for eq in all_equilibria(pair, p, q):
            verdict = assess_stability(eq)
            assert verdict.stable == eq.stable
            if np.abs(eq.nodes[:, 1:3]).max() < 1000:  # the sweep resolves it
                assert count_conjugate_points(eq) == 0
            assert (verdict.rod_margins > 0).all()
            stable += verdict.stable
            unstable += not verdict.stable
            assert verdict.unstable_directions == (eq.stiffness_eigenvalues < 0).sum()
    assert stable > 60
    assert unstable > 20


def test_held_shapes_are_equilibria_and_all_different(pair, centre):
    found = all_equilibria(pair, (0.18, 0.12), centre.q)
    assert len(found) == 6
    assert [eq.energy for eq in found] == sorted(eq.energy for eq in found)
    for eq in found:
        again = solve_statics(pair, eq.p, eq.q, method="multiple_shooting", guess=eq)
        assert again.force == pytest.approx(eq.force, rel=1e-4, abs=1e-4)
    assert len({(eq.mode, round(eq.energy, 6)) for eq in found}) == 6


def test_number_of_stable_shapes_of_a_rod():
    """One to three for each handedness and tip, by a finer search: every stable (tip_angle, lambda) that maps there."""
    rng = np.random.default_rng(5)
    for _ in range(2):
        r, a = 0.9 * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
        target = r * np.array([np.cos(a), np.sin(a)])
        found = stable_shapes(*target)
        seen = set()
        newton, _ = elastica.rod_newton()
        for hand in (1.0, -1.0):
            for log_tip_angle in np.linspace(-9.0, np.log(3.1), 30):
                for fraction in np.linspace(0.05, 0.99, 16):
                    load = fraction * min(critical_load(log_tip_angle), 20.0)
                    u = np.array([log_tip_angle, load, hand])
                    for _ in range(12):
                        step, *_, scalars = newton(u, [*target, 0.0])
                        step = step.full().ravel()
                        u = u + step * min(1.0, 0.5 / max(np.abs(step).max(), 1e-12))
                        if not (np.isfinite(u).all() and -15 < u[0] < np.log(3.14) and 0.05 < u[1] < 25):
                            break
                    else:
                        if float(scalars[0]) < 1e-9 and u[1] < critical_load(u[0]):
                            seen.add((hand, round(u[1], 4)))
        listed = {(float(shape.hand), round(shape.load, 4)) for shape in found if shape.load < 25}
        assert listed >= seen


@pytest.fixture(scope="module", params=["apart", pytest.param("pair", marks=pytest.mark.slow)])
def free(pair, centre, request):
    """All free poses; of rods that stand apart, for they meet in a small region, which keeps the search short."""
    if request.param == "pair":
        return all_equilibria(pair, q=centre.q)
    rods = [replace(rod, base=(3 * rod.base[0], 0.0), angle_limits=(-4.0, 4.0)) for rod in pair.rods]
    return all_equilibria(replace(pair, rods=tuple(rods)), q=(1.0, np.pi - 1.0))


def test_free_equilibria_come_in_mirror_pairs(free, pair):
    """The motors are turned symmetrically, so every pose has its mirror image in the list, or is its own."""
    assert sum(eq.stable for eq in free) == (4 if free[0].robot is pair else 5)
    assert len({tuple(np.sign(np.round(eq.p, 6)).tolist()) for eq in free}) >= 3
    for eq in free:
        assert np.abs(eq.force).max() < 1e-6
        mirrored = [other for other in free if np.allclose(other.p, eq.p * [-1, 1], atol=1e-6)]
        assert any(other.energy == pytest.approx(eq.energy, abs=1e-8) for other in mirrored)


def test_a_stable_pose_returns_and_an_unstable_one_leaves(free):
    """The verdict against the dynamics: a nudge of 10 um."""
    for eq in (free[1], next(eq for eq in free if not eq.stable)):
        plant = Plant(eq.robot, integrator="velocity_verlet", dt=1e-3)
        weakest = np.linalg.eigh(eq.dforce_dp)[1][:, 0]
        x = np.concatenate([eq.p + 1e-5 * weakest, [0, 0], eq.q])
        plant.reset(x, eq)
        for _ in range(900):
            x = plant.step(x, (0.0, 0.0))
            if np.linalg.norm(x[:2] - eq.p) > 1e-3:
                break
        assert (np.linalg.norm(x[:2] - eq.p) < 1e-4) == eq.stable


def test_an_unstable_balance_is_refused(free):
    """Near a saddle of the energy the motors can balance the tip, but not hold it."""
    saddle = next(eq for eq in free if not eq.stable)
    with pytest.raises(UnstableError, match="not stable") as caught:
        inverse_statics(saddle.robot, saddle.p + [1e-3, 0.0], guess=saddle)
    assert caught.value.eigenvalue == pytest.approx(saddle.stiffness_eigenvalues[0], rel=0.1)


@pytest.mark.parametrize("load", [7.2, 11.0])
def test_a_rod_beyond_its_limit_is_told_by_every_method(pair, load):
    """k = 0.6: lambda_c is 6.7, and at 11 the determinant has changed its sign twice."""
    nodes = elastica.nodes(np.array([np.log(2 * np.arccos(0.6)), load, 1.0]), 0.0, 8)
    p = pair.rods[0].base + pair.rods[0].length * sample_rod(nodes, 2)[:2, -1]
    # The other rod takes any stable shape.
    other = np.arctan2(*(p - pair.rods[1].base)[::-1]) + 0.5
    gentle = solve_statics(pair, p, (0.5, other)).nodes[1]
    guess = np.stack([nodes, sample_rod(gentle, 9)[2:, :8]])
    for method in ("closed_form", "multiple_shooting", "single_shooting"):
        eq = solve_statics(pair, p, (0.0, other), method=method, guess=guess)
        assert eq.unstable_rods == (0,), method
        assert not eq.stable
        assert assess_stability(eq).rod_margins[0] < 0
        assert assess_stability(eq).unstable_directions >= (1 if load < 10 else 2)


@pytest.mark.parametrize("method", ["closed_form", "multiple_shooting"])
@pytest.mark.parametrize("turn", [4.4, -4.0])
@pytest.mark.parametrize("steps", [1, 7, 60])
def test_the_plant_never_walks_through_a_fold(pair, centre, method, turn, steps):
    """Wind one motor up until its rod would snap, in steps of any size: an error, and the plant is as it was."""
    plant = Plant(pair, method=method)
    x = np.concatenate([centre.p, [0, 0], centre.q])
    plant.reset(x, centre)
    before = plant.force(centre.p + [0.01, 0], centre.q)

    def wind_up():
        for angle in np.linspace(0.0, turn, steps + 1)[1:]:
            plant.force(centre.p, centre.q + [angle, 0.0])

    with pytest.raises(UnstableError, match="snap") as caught:
        wind_up()
    assert caught.value.rod in (0, (0,))
    if steps == 1:
        assert plant.force(centre.p + [0.01, 0], centre.q) == pytest.approx(before, abs=1e-9)


def test_distance_to_fold(pair, centre):
    """Turning both motors until K loses its definiteness: the eigenvalue is zero where it says."""
    end = centre.q + [-1.5, 1.5]
    fraction = distance_to_fold(centre, centre.p, end)
    assert 0.5 < fraction < 1.0

    def weakest(t):
        eq = centre
        for s in np.linspace(0, t, 40)[1:]:
            eq = solve_statics(pair, centre.p, centre.q + s * (end - centre.q), guess=eq)
        return eq.stiffness_eigenvalues[0]

    assert weakest(fraction) > 0 > weakest(fraction + 1e-4)
    assert distance_to_fold(centre, centre.p + [0.01, 0.0], centre.q) == 1.0


def test_a_held_tip_out_of_reach(pair):
    with pytest.raises(UnreachableError):
        all_equilibria(pair, (0.5, 0.0), (3.0, 0.0))
