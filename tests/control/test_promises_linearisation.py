"""What the docstrings of the linear models and of the limits of poses promise, one promise a test."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import Equilibrium, Plant, Robot, assess_stability, linearise
from pcr_mpc.linearisation.linear_limits import KINDS
from pcr_mpc.linearisation.pose_limits import LimitWatch, PoseLimits

DT = 0.01


@pytest.fixture(scope="module")
def x0(centre: Equilibrium) -> np.ndarray:
    return np.concatenate([centre.p, [0.0, 0.0], centre.q])


def linearised(robot: Robot, centre: Equilibrium, x: np.ndarray, dt: float = DT, **more):
    plant = Plant(robot)
    plant.reset(x, centre)
    return linearise(plant, x, (0.0, 0.0), dt, **more)


def test_too_much_drag_for_the_period_is_refused(pair, centre, x0):
    """(c dt / m)^2 at most 1000: on either side of it."""
    most = np.sqrt(1e3) * pair.tip_mass / DT
    assert np.isfinite(linearised(replace(pair, drag=0.999 * most), centre, x0).A).all()
    with pytest.raises(ValueError, match=r"for the drag: .* \(c dt/m\)\^2 is 1e\+03, at most 1000; shorten the period"):
        linearised(replace(pair, drag=1.001 * most), centre, x0)


def test_too_much_stiffness_for_the_period_is_refused(pair, centre, x0):
    """K dt^2 / m at most 1000: on either side of it."""
    longest = np.sqrt(1e3 * pair.tip_mass / np.abs(centre.dforce_dp).max())
    assert np.isfinite(linearised(replace(pair, drag=0.0), centre, x0, 0.999 * longest).A).all()
    with pytest.raises(ValueError, match=r"too long for the stiffness .* K dt\^2/m is 1e\+03"):
        linearised(replace(pair, drag=0.0), centre, x0, 1.001 * longest)


@pytest.mark.parametrize("dt", [0.0, -0.01, np.nan, np.inf, True, "0.01"])
def test_a_period_is_a_positive_number(pair, centre, x0, dt):
    with pytest.raises(ValueError, match="dt"):
        linearised(pair, centre, x0, dt)


def test_an_overflowing_model_is_refused(pair, centre, x0):
    with pytest.raises(ValueError, match=r"the linear model at x = .* with external force .* N is not finite"):
        linearised(pair, centre, x0, f_ext=(1e308, 1e308))


def test_the_input_is_checked_and_changes_nothing(pair, centre, x0):
    plant = Plant(pair)
    plant.reset(x0, centre)
    one, other = (linearise(plant, x0, u, DT) for u in ((0.0, 0.0), (3.0, -5.0)))
    assert (one.A == other.A).all()
    assert (one.c == other.c).all()
    with pytest.raises(ValueError, match="u is not finite"):
        linearise(plant, x0, (np.nan, 0.0), DT)


def test_a_model_says_its_period_and_force_and_cannot_be_changed(pair, centre, x0):
    force = np.array([0.3, -0.4])
    model = linearised(pair, centre, x0, 0.02, f_ext=force)
    force[:] = 9.0
    assert model.dt == 0.02
    assert model.force.tolist() == [0.3, -0.4]
    for name in ("A", "B", "c", "E", "force"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(model, name)[:] = 0.0
    # The force it was made for is in c, to the effect E.
    bare = linearised(pair, centre, x0, 0.02)
    assert model.c - bare.c == pytest.approx(bare.E @ [0.3, -0.4], abs=1e-12)
    assert model.E[4:].tolist() == [[0.0, 0.0]] * 2


def test_state_space_is_the_linear_part_with_the_tip_as_output(pair, centre, x0):
    model = linearised(pair, centre, x0)
    system = model.to_control()
    assert (system.A == model.A).all()
    assert (system.B == model.B).all()
    assert system.C.tolist() == np.eye(2, 6).tolist()
    assert not system.D.any()
    assert system.dt == DT


# Limits of poses


def watched(limits: PoseLimits, plant: Plant, pose: Equilibrium):
    x = np.concatenate([pose.p, [0.1, 0.2], pose.q])
    watch = LimitWatch(limits, plant)
    watch.reset(x, pose)
    return watch, x


def at(rows, kind: str, x: np.ndarray) -> np.ndarray:
    """What the rows of one kind say of state x, in their own units."""
    chosen = [i for i, k in enumerate(rows.kinds) if k == kind]
    return rows.scale[chosen] * (rows.C @ x)[chosen]


def test_torques_of_sagging_rods_are_their_own(heavy, sagging):
    """Rods with exact weight: the torques of the plant's equilibrium, weight and all, as far as both stops of them."""
    limit = 0.5 * float(np.abs(sagging.motor_torque).max())
    plant = Plant(heavy)
    assert plant.weight == "exact"
    watch, x = watched(PoseLimits(torque=limit), plant, sagging)
    rows = watch.rows(x)
    assert rows.kinds == ("torque", "torque")
    # lower <= C x <= upper with C x = tau / limit + const: the bounds are at -limit and +limit.
    tau = sagging.motor_torque
    assert at(rows, "torque", x) - rows.scale * rows.lower - limit == pytest.approx(tau, abs=1e-6)
    assert rows.scale * rows.upper - at(rows, "torque", x) == pytest.approx(limit - tau, abs=1e-6)
    weightless, x = watched(PoseLimits(torque=limit), Plant(heavy, weight="none"), sagging)
    bare = weightless.rows(x)
    assert np.abs(bare.scale * bare.upper - at(bare, "torque", x) - (limit - tau)).max() > 1e-3


def test_margins_of_rods_that_are_not_plain_are_not_watched(general, bent):
    """Torque and tip region are; folds, which nobody knows of such rods, are no limits."""
    asked = PoseLimits(1e-3, (-0.1, 0.0), (0.1, 0.3), rod_margin=0.99, stiffness=1e6)
    watch, x = watched(asked, Plant(general), bent)
    assert (watch.limits.rod_margin, watch.limits.stiffness) == (None, None)
    assert (watch.limits.torque, watch.limits.tip_lower) == (1e-3, (-0.1, 0.0))
    assert watch.rows(x).kinds == ("torque",) * 2 + ("tip region",) * 2
    assert watch.combinations() == [("torque",) * 2, ("tip region",) * 2, ("torque",) * 2 + ("tip region",) * 2]


def test_a_plant_that_shoots_is_watched_in_closed_form_where_that_holds(pair, centre):
    asked = PoseLimits(rod_margin=0.99, stiffness=1e6)
    watch, x = watched(asked, Plant(pair, method="multiple_shooting"), centre)
    assert watch.limits == asked
    exact, _ = watched(asked, Plant(pair), centre)
    assert watch.rows(x).C == pytest.approx(exact.rows(x).C, rel=1e-6, abs=1e-9)


def test_nothing_asked_is_nothing_watched(pair, centre):
    watch, x = watched(PoseLimits(), Plant(pair), centre)
    assert watch.rows(x) is None
    assert watch.combinations() == []


def test_combinations_are_all_that_rows_may_give(pair):
    strips = replace(pair, rods=tuple(replace(rod, thickness_ratio=1e-3 / rod.length) for rod in pair.rods))
    watch = LimitWatch(PoseLimits(1.0, (-1, -1), (1, 1), 0.1, 1.0, 0.01), Plant(strips))
    found = watch.combinations()
    assert len(found) == len(set(found)) == 2**5 - 1
    widths = dict(zip(KINDS, (2, 2, 2, 1, 2), strict=True))
    for kinds in found:
        assert all(kinds.count(kind) == widths[kind] for kind in set(kinds))
        assert list(dict.fromkeys(kinds)) == [kind for kind in KINDS if kind in kinds]


@pytest.mark.parametrize("kind", ["torque", "stiffness", "rod margin"])
def test_limits_are_watched_as_soon_as_they_come_near(pair, poses, kind):
    """Torques from 0.6 of their limit on, the stiffness from three times its own, margins from 0.25 above theirs."""
    pose = poses[0]
    verdict, most = assess_stability(pose), float(np.abs(pose.motor_torque).max())
    for near in (True, False):
        by = 1.01 if near else 0.99
        limits = {
            "torque": PoseLimits(torque=most / (0.6 * by)),
            "stiffness": PoseLimits(stiffness=verdict.stiffness_eigenvalues[0] * by / 3),
            "rod margin": PoseLimits(rod_margin=float(verdict.rod_margins.min()) - 0.25 + by - 1),
        }[kind]
        watch, x = watched(limits, Plant(pair), pose)
        rows = watch.rows(x)
        assert (None if rows is None else set(rows.kinds)) == ({kind} if near else None)
