"""What a plan says, and its command: limits that are kept or not, what cannot be planned, files."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import (
    Blended,
    ConvergenceError,
    InfeasibleError,
    Line,
    ModelError,
    PlanLimits,
    UnreachableError,
    UnstableError,
    Waypoints,
    load_path,
    load_scene,
    plan_timing,
)
from pcr_mpc.cli import main
from pcr_mpc.linearisation.pose_limits import PoseLimits
from pcr_mpc.loop.references.tabulated import Tabulated
from pcr_mpc.loop.references.trajectory import PickAndPlace
from pcr_mpc.report.designs.plan_table import plan_table
from pcr_mpc.study.planning.along_path.path import paths_of
from tests.conftest import MODELS
from tests.references.drawn import rows


@pytest.mark.parametrize(
    ("excess", "words"),
    [(-5e-4, "limits kept, 99.950 %"), (4e-5, "limits kept to 0.1 %, 100.004 %"), (2e-3, "limits exceeded: 100.200 %")],
)
def test_limits_are_said_to_be_kept_or_not_and_never_both(planned, excess, words):
    """Whatever is left or beyond is a share of the limit that is used."""
    assert f"{words} of one at most" in plan_table(planned.summary() | {"largest_excess": excess})


def test_a_rough_path_is_told_from_one_with_a_corner(scene):
    t, points = rows()
    rough = Tabulated(t, points)
    with pytest.raises(ModelError, match=rf"rough.* scatter by about .* smoothing = {rough.scatter:.2g}$"):
        paths_of(Blended(rough), t[-1], 5e-5)
    paths_of(Blended(replace(rough, smoothing=rough.scatter)), t[-1], 5e-5)


def test_a_corner_wants_a_rest_or_is_rounded():
    """Without a rest it is rounded within the tolerance, if that can be; with one the path has two legs that meet."""

    def round_the_corner(t):
        way = np.stack([np.minimum(t, 0.1), 0.2 + np.maximum(t - 0.1, 0.0)], axis=1)
        rate = np.stack([t < 0.1, t >= 0.1], axis=1).astype(float)
        return np.stack([way, rate, np.zeros_like(way)], axis=1)

    with pytest.raises(ModelError, match=r"round the corner, or allow more \(--tolerance, tolerance\)$"):
        paths_of(round_the_corner, 0.2, 1e-9)
    (rounded,) = paths_of(round_the_corner, 0.2, 5e-5)
    away = np.linalg.norm(rounded.derivatives(np.linspace(0.0, rounded.length, 10001))[0] - [0.1, 0.2], axis=1).min()
    assert 1e-6 < away < 5e-5
    first, second = paths_of(Waypoints(((0.0, 0.2), (0.1, 0.2), (0.1, 0.3)), speed=0.1), 4.0, 5e-5)
    assert first.length == pytest.approx(0.1, abs=1e-9)
    assert first.derivatives(np.array([first.length]))[0, 0] == pytest.approx([0.1, 0.2], abs=1e-9)
    assert second.derivatives(np.zeros(1))[0, 0] == pytest.approx([0.1, 0.2], abs=1e-9)
    # Points in line are no corner: the tip need not rest there.
    assert len(paths_of(Waypoints(((0.0, 0.2), (0.05, 0.2), (0.1, 0.2)), speed=0.1), 4.0, 5e-5)) == 1


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        ({"trajectory": PickAndPlace((-0.06, 0.22), (0.35, 0.22), 0.0, 0.0, 1.0)}, UnreachableError, "rod 0"),
        ({"pose_limits": PoseLimits(tip_lower=(-0.1, 0.1), tip_upper=(0.1, 0.25))}, InfeasibleError, "20 mm outside"),
        ({"pose_limits": PoseLimits(stiffness=70.0)}, InfeasibleError, "70 N/m"),
        ({"trajectory": None, "tuning": None}, ModelError, "no reference"),
        ({"trajectory": PickAndPlace((-0.06, 0.22), (-0.06, 0.22), 0.0, 0.0, 1.0)}, ModelError, "nothing to plan"),
    ],
)
def test_what_cannot_be_planned_is_said_with_numbers(scene, change, error, message):
    with pytest.raises(error, match=message):
        plan_timing(replace(scene, **change))


def test_a_speed_that_would_take_hours_is_refused_for_that(scene):
    """To rest on the path is no trouble."""
    with pytest.raises(InfeasibleError, match=r"\(tip speed\) even if all of the path takes 1e\+04 s"):
        plan_timing(scene, limits=PlanLimits.of_scene(scene, tip_speed=1e-6))


def test_a_torque_that_does_not_hold_the_tip_is_said(scene):
    limits = replace(PlanLimits.of_scene(scene), torque=0.7)
    with pytest.raises(InfeasibleError, match=r"to rest there takes .* N m, where 0.7 N m are allowed") as caught:
        plan_timing(scene, limits=limits)
    assert caught.value.limit == "motor torque"
    assert 0.0 <= caught.value.s <= 0.17


def test_a_path_through_a_fold_says_where(scene):
    """Down between the motors the rods' branch ends."""
    trajectory = Line(points=((-0.06, 0.22), (0.1, -0.2)), speed=0.1)
    with pytest.raises((UnstableError, ConvergenceError, UnreachableError), match=r"the path at .* mm from its start"):
        plan_timing(replace(scene, trajectory=trajectory))


def test_the_lines_that_are_to_be_put_into_a_scene_are_found_from_there(planned, tmp_path, monkeypatch, capsys):
    mine = tmp_path / "mine" / "scene.toml"
    mine.parent.mkdir()
    text = (MODELS / "scenes" / "eight_points.toml").read_text()
    mine.write_text(text.replace("../../", f"{MODELS.parent}/").replace('"../', f'"{MODELS}/'))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("pcr_mpc.cli.plan.plan_timing", lambda *_, **__: planned)
    for given in ("mine/scene.toml", "eight_points"):
        for out in (["--out", "fast.csv"], []):
            assert main(["plan", given, "--no-pictures", *out]) == 0
            lines = capsys.readouterr().out.partition("[reference]\n")[2]
            kept = re.sub(r"^\[reference\]\n(\w.*\n)*|^duration.*", "", mine.read_text(), flags=re.MULTILINE)
            (mine.parent / "fast.toml").write_text(f"{kept}\n[reference]\n{lines}")
            found = load_scene(mine.parent / "fast.toml")
            assert planned.duration <= found.duration < planned.duration + 10 * found.period


def test_the_command_writes_a_path_and_a_picture(tmp_path, capsys):
    out = tmp_path / "fast.csv"
    command = ["plan", str(MODELS / "scenes" / "pick_and_place.toml"), "--out", str(out), "--cells", "40"]
    assert main([*command, "--json", "--tip-speed", "0.5"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["duration_s"] == pytest.approx(load_path(out).duration)
    assert found["largest_excess"] <= 1e-3
    assert found["top_speed_m_s"] == pytest.approx(0.5, rel=2e-3)
    # Two rods of 5.6 g beside 250 g: less than all of them, for they are clamped at one end.
    assert 0.005 < found["share_of_rods"] < 11.1 / 261.1
    left_out = {"asked": dict.fromkeys(("rate_rad_s", "rate_change_rad_s2", "torque_Nm"), 2.0)}
    left_out["shares"] = {"rate": 4 / 3, "strains": 0.5}
    left_out["limits"] = dict.fromkeys(left_out["asked"], 1.5)
    told = plan_table(found | {"share_of_rods": 0.38, "rods_left_out": left_out})
    assert "38 % of the mass that moves, left out" in told
    assert "with it the motors are asked for 2 of 1.5 rad/s, " in told
    assert "limits kept by rods without mass" in told
    assert {row["limit"] for row in found["limits"]} >= {"motor rate", "change of rate", "tip speed"}
    assert (tmp_path / "fast.png").stat().st_size > 10_000
    out.write_text("mine")
    assert main(command) == 1
    assert "left alone" in capsys.readouterr().err
    assert out.read_text() == "mine"
