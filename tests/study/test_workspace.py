"""The workspace of `experiments/statics/workspace.py` against symmetry, finite differences and the free tip."""

import csv
import sys

import numpy as np
import pytest

from experiments.statics import workspace
from experiments.statics.workspace import areas, stop_distance
from pcr_mpc import Equilibrium, PCRError, Robot, forward_statics, inverse_statics, solve_statics
from pcr_mpc.study.workspace_sheet import Sheet, explore, turn_between


@pytest.fixture(scope="module")
def around_centre(centre: Equilibrium) -> Sheet:
    return explore(centre, spacing=0.015, most=20)


@pytest.fixture(scope="module")
def at_fold(pair: Robot) -> Sheet:
    """A corner of mode LL, up to where the tip snaps."""
    return explore(inverse_statics(pair, (0.08, 0.09), mode="LL"), spacing=0.01, most=20)


def test_mirror_image_of_the_robot(around_centre):
    positions = {tuple(p.round(9)): site for site, p in around_centre.tips.items()}
    compared = 0
    for eq in around_centre.poses.values():
        other = around_centre.poses.get(positions[tuple((eq.p * [-1, 1]).round(9) + 0.0)])
        if other is not None:
            assert turn_between(np.pi - other.q[::-1], eq.q) == pytest.approx([0, 0], abs=1e-7)
            assert other.stiffness_eigenvalues == pytest.approx(eq.stiffness_eigenvalues, rel=1e-6)
            compared += 1
    assert compared >= 12


def test_poses_are_balanced_and_of_one_mode(around_centre, pair):
    for eq in around_centre.poses.values():
        assert eq.stable
        assert eq.mode == "LR"
        # By the other method, which knows no elliptic functions.
        again = solve_statics(pair, eq.p, eq.q, method="multiple_shooting", guess=eq)
        assert again.force == pytest.approx([0, 0], abs=1e-5)


def test_stiffness_against_differences_of_the_force(at_fold, pair):
    for eq in [*at_fold.poses.values()][:3]:
        step, columns = 1e-6, []
        for move in step * np.eye(2):
            ahead, back = (solve_statics(pair, eq.p + s * move, eq.q, guess=eq).force for s in (1, -1))
            columns.append((ahead - back) / (2 * step))
        assert np.linalg.eigvalsh(np.array(columns)) == pytest.approx(eq.stiffness_eigenvalues, rel=1e-5)


def out_of_the_fold(eq: Equilibrium) -> np.ndarray:
    """Unit motor motion across a fold, to the side without poses."""
    step = 1e-4 * np.linalg.eigh(eq.dforce_dp)[1][:, 0]  # m, where the tip is softest
    ahead, back = (step @ solve_statics(eq.robot, eq.p + move, eq.q, guess=eq).force for move in (step, -step))
    # There the force is (ahead + back) / 2 (s / step)^2 + across . dq: zero where the two differ in sign.
    across = eq.dforce_dq.T @ step
    return np.sign(ahead + back) * across / np.linalg.norm(across)


def test_free_tip_leaves_at_the_type_2_curve(at_fold, pair):
    """Motors short of the curve hold a pose nearby; beyond, no branch leads on: an error, or a pose far away."""
    ends = [end for end in at_fold.ends.values() if end.reason == "type 2"]
    assert len(ends) >= 6
    for end in ends[:: len(ends) // 3]:
        assert 0 < end.pose.stiffness_eigenvalues[0] < 1
        outward = out_of_the_fold(end.pose)
        inside = forward_statics(pair, end.pose.q - 1e-3 * outward, guess=end.pose)
        assert np.linalg.norm(inside.p - end.pose.p) < 0.01
        try:
            beyond = forward_statics(pair, end.pose.q + 1e-3 * outward, guess=end.pose)
        except PCRError:
            continue
        assert np.linalg.norm(beyond.p - end.pose.p) > 0.1


def test_area_of_a_patch(around_centre):
    """Interior triangles alone: each of sqrt(3)/4 spacing^2."""
    total = areas(around_centre)
    n_triangles = total["stable"] / (np.sqrt(3) / 4 * (0.015 / 0.4) ** 2)
    assert n_triangles == pytest.approx(round(n_triangles), abs=1e-6)
    assert 20 <= round(n_triangles) <= 40
    assert total["connected_within_stops"] == pytest.approx(total["within_stops"])


def test_stop_distance(pair):
    lower, upper = pair.angle_limits.T
    assert stop_distance(pair, upper) == pytest.approx(0)
    assert stop_distance(pair, lower + 2 * np.pi) == pytest.approx(0)
    assert stop_distance(pair, upper + [0.1, -0.3]) == pytest.approx(0.1)


def test_quick_run_writes_every_tip(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["workspace.py", "--quick", "--out", str(tmp_path)])
    workspace.main()
    assert "areas in L^2" in capsys.readouterr().out
    rows = list(csv.DictReader((tmp_path / "workspace.csv").read_text(encoding="utf-8").splitlines()))
    assert all(bool(row["failure"]) != bool(row["stable"]) for row in rows)
    assert sum(row["stable"] == "True" for row in rows) == 40
    assert any(row["failure"].startswith("type 2") for row in rows)
    assert (tmp_path / "workspace_LL.png").stat().st_size > 5_000
