"""The studies run, and what they rest on holds."""

from dataclasses import replace

import numpy as np
import pytest

from experiments.motion import rod_inertia
from experiments.speed import growth
from experiments.statics import basins


@pytest.fixture(scope="module")
def basin_trials(pair):
    # Single shooting spends seconds in failing on taut rods: left to the full run.
    return basins.measure(pair, replace(basins.QUICK, methods=("N = 8", "closed form")))[0]


def test_basins_have_a_row_for_every_method_class_and_size(basin_trials):
    found = {(row["study"], row["class"], row["method"], row["size"]) for row in basin_trials}
    for name in basins.CLASSES:
        for method in ("N = 8", "closed form"):
            assert {("perturbed nodes", name, method, size) for size in (0.0, *basins.QUICK.sigmas)} <= found
            assert {("moved tip", name, method, size) for size in basins.QUICK.distances} <= found
    assert len(found) == len(basins.CLASSES) * 2 * 3


def test_basins_small_perturbations_and_none_return_to_the_branch(basin_trials):
    for row in basin_trials:
        if row["study"] == "perturbed nodes" and (row["class"] != "taut" or row["size"] == 0.0):
            assert row["outcome"] == "same", row


def test_basins_failures_say_why(basin_trials):
    outcomes = {row["outcome"] for row in basin_trials}
    assert outcomes <= {*basins.OUTCOMES, "branch ends"}
    lost = [row for row in basin_trials if row["outcome"] in ("failed", "branch ends")]
    assert lost  # the closed form on taut rods, for one
    assert all(row["error"] and row["message"] for row in lost)
    assert all(row["force_error"] != "" for row in basin_trials if row not in lost)


def test_basins_half_size():
    rows = [
        {"study": "moved tip", "class": "bent", "pose": pose, "method": "single", "size": size, "outcome": outcome}
        for pose, outcomes in enumerate([("same", "same", "other"), ("same", "failed", "branch ends")])
        for size, outcome in zip((0.01, 0.1, 1.0), outcomes, strict=True)
    ]
    sizes, counts = basins.successes(rows, "moved tip", "bent", "single")
    assert counts[1].sum(axis=0).tolist() == [2, 2, 1]
    assert basins.half_size(sizes, counts) == (pytest.approx(0.1), "")
    assert basins.half_size(sizes[:1], counts[:, :, :1]) == (0.01, ">")
    assert basins.half_size(sizes[2:], counts[:, :, 2:]) == (1.0, "<")


def test_rod_inertia_ladder(pair):
    """Each rung is an order of magnitude better than the one before, and the yardstick is known better than all."""
    rows = rod_inertia.compare(pair, "displaced", 1.0, rod_inertia.QUICK_DURATION)
    errors = {row["inertia"]: row["error_mm"] for row in rows}
    assert errors["none"] > 0.5
    assert errors["constant"] < 0.2 * errors["none"]
    assert errors["condensed"] < min(0.02 * errors["constant"], 5e-3)
    assert errors["full"] < 0.1 * errors["condensed"]


def test_growth_fit_tells_the_fixed_part_from_the_growing_one():
    n = np.array([1.0, 2.0, 4.0, 8.0, 16.0])
    slope, fixed, growing = growth.fit(n, 30.0 + 2.0 * n**2, 2.0)
    assert (fixed, growing) == (pytest.approx(30.0), pytest.approx(2.0))
    assert slope == pytest.approx(np.polyfit(np.log(n[2:]), np.log(30.0 + 2.0 * n[2:] ** 2), 1)[0])
    assert growth.fit(n, 5.0 * n, 1.0) == (pytest.approx(1.0), pytest.approx(0.0, abs=1e-9), pytest.approx(5.0))


@pytest.mark.parametrize("n", [2, 3, 8])
def test_growth_robots_rest_at_the_centre(pair, n):
    robot, pose = growth.circle(pair, n)
    assert robot.n_rods == n
    assert pose.stable
    assert pose.force == pytest.approx([0.0, 0.0], abs=1e-9)
    assert pose.p == pytest.approx(growth.CENTRE)
