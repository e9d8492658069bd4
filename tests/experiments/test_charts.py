"""What the charts of speed against accuracy rest on."""

import numpy as np
import pytest

from experiments.charts import points, ratios, statics
from experiments.charts.control import DO_MPC
from experiments.charts.draw import Look, draw_points
from experiments.charts.motion import MUJOCO
from experiments.charts.statics_poses import CLASSES, make_poses
from experiments.peers.literal_reading import LiteralReading
from pcr_mpc import ConvergenceError, Plant, solve_statics
from pcr_mpc.report.style import plt


def row(case, method, settings, time, error, **others):
    known = {"level": "any", "ours": True, "success": 4, "attempts": 4, "time_p50": time, "error": error, "remark": ""}
    return known | {"case": case, "method": method, "settings": settings} | others


def test_literal_reading_closes_its_count_and_both_ways_to_integrate_agree(pair, centre):
    for segments, steps in ((1, 16), (4, 2), (8, 4)):
        one_by_one, at_once = (LiteralReading(pair, segments, steps, at_once=way) for way in (False, True))
        unknowns = one_by_one.guess(centre) + 0.01 * np.random.default_rng(1).normal(size=8 * segments)
        found = one_by_one.residual(unknowns, centre.p, centre.q)
        assert found.shape == (8 * segments,)
        assert at_once.residual(unknowns, centre.p, centre.q) == pytest.approx(found, abs=1e-14)
        assert np.abs(found).max() > 1e-3


def test_literal_reading_converges_to_the_exact_rods(pair, centre):
    """An exact pose leaves a residual of fourth order in the step; solved elsewhere the force is right as far."""
    target = solve_statics(pair, centre.p + [2e-3, -1e-3], centre.q + [0.01, 0.02], guess=centre)
    left, errors = [], []
    for steps in (2, 4):
        literal = LiteralReading(pair, 8, steps, at_once=True)
        left.append(np.abs(literal.residual(literal.guess(centre), centre.p, centre.q)).max())
        solution = literal.solve(target.p, target.q, literal.guess(centre))
        errors.append(np.linalg.norm(solution.force - target.force) / np.linalg.norm(target.rod_forces))
        assert solution.evaluations == solution.iterations * (8 * 8 + 1)
    assert left[0] / left[1] == pytest.approx(16, rel=0.2)
    assert errors[0] / errors[1] == pytest.approx(16, rel=0.3)
    assert errors[1] < 1e-5


def test_literal_reading_says_where_it_fails(pair, centre):
    literal = LiteralReading(pair, 1, 8, at_once=True)
    with pytest.raises(ConvergenceError, match="stopped with residual"):
        literal.solve(np.array([0.6, 0.6]), centre.q, literal.guess(centre))
    with pytest.raises(ConvergenceError, match="literal reading"):
        literal.solve(centre.p, centre.q, np.full(8, np.nan))


def test_literal_reading_steps_as_the_plant_does(pair, centre):
    """The same scheme with the rods of another code: after ten steps apart by the error of its four RK4 steps."""
    pose = solve_statics(pair, centre.p + [0.03, 0.02], centre.q, guess=centre)
    x = np.concatenate([pose.p, [0.1, -0.2], pose.q])
    plant, literal, rates = Plant(pair, dt=1e-3), LiteralReading(pair, at_once=True), np.array([0.5, -0.3])
    plant.reset(x, pose)
    y, rods = x, literal.solve(x[:2], x[4:], literal.guess(pose))
    for _ in range(10):
        x, (y, rods) = plant.step(x, rates), literal.step(y, rates, rods, 1e-3)
    assert y == pytest.approx(x, abs=5e-6)
    assert np.linalg.norm(x[:2] - pose.p) > 1e-3


@pytest.fixture(scope="module")
def poses(pair):
    return make_poses(pair, 3)


def test_poses_are_stable_close_to_their_start_and_answered_exactly(poses):
    assert [pose.name for pose in poses] == [name for name in CLASSES for _ in range(3)]
    for pose in poses:
        assert pose.target.stable
        assert np.linalg.norm(pose.target.p - pose.neighbour.p) == pytest.approx(3e-4)
        for name in ("force", "dforce_dp", "dforce_dq"):
            right = getattr(pose, {"force": "force", "dforce_dp": "k", "dforce_dq": "g"}[name])
            size = np.linalg.norm(pose.target.rod_forces) if name == "force" else np.abs(right).max()
            assert getattr(pose.target, name) == pytest.approx(right, abs=1e-9 * size)
    softest = {name: [p.target.stiffness_eigenvalues[0] for p in poses if p.name == name] for name in CLASSES}
    assert np.median(softest["near fold"]) < 0.2 * np.median(softest["bent"])


def test_a_point_of_statics_counts_failures_and_measures_the_rest(pair):
    plan = statics.Plan(poses=2)
    good = statics.measure(pair, plan, ("taut", "multiple shooting", "N = 8, 4 x rk8"))
    assert good["success"] == good["attempts"] == 2
    assert good["error"] < 1e-7
    assert good["evaluations"] == good["iterations"] + 1
    # One that raises, and one that answers wrongly.
    for name, settings, remark in (("taut", "N = 1, 1 x rk4", "Error"), ("bent", "N = 2, 1 x rk4", "is off by")):
        bad = statics.measure(pair, plan, (name, "multiple shooting", settings))
        assert (bad["success"], bad["attempts"]) == (0, 2)
        assert remark in bad["remark"]
        assert "time_p50" not in bad


def test_derivatives_implicitly_are_better_than_by_differences(pair, poses):
    for way in ("implicit", "differences"):
        answer = statics.make_method(pair, "closed form", f"exact, {way}")(poses[0])()
        assert answer.k == pytest.approx(poses[0].k, rel=1e-4)
        assert answer.g == pytest.approx(poses[0].g, rel=1e-4)
    plan = statics.Plan(poses=2)
    errors = {
        way: statics.measure(pair, plan, (statics.DERIVATIVES, "closed form", f"exact, {way}"))["error"]
        for way in ("implicit", "differences")
    }
    assert errors["implicit"] < 1e-11 < errors["differences"] < 1e-7


def test_collect_goes_on_where_it_stopped(tmp_path, monkeypatch):
    measured = []

    def measure(key):
        measured.append(key)
        if key[0] == "stop":
            raise KeyboardInterrupt
        return {"ours": True, "success": 1, "attempts": 1, "error": 1e-3, "time_p50": 2e-3}

    keys = [("a", "m", "1, 2"), ("b", "m", "s"), ("stop", "m", "s")]
    monkeypatch.setattr(points, "commit", lambda: "abc")
    with pytest.raises(KeyboardInterrupt):
        points.collect("level", keys, measure, tmp_path)
    kept = points.read(tmp_path / "accuracy_vs_speed_level.csv")
    assert [(r["case"], r["settings"], r["error"], r["ours"]) for r in kept] == [
        ("a", "1, 2", 1e-3, True),
        ("b", "s", 1e-3, True),
    ]
    measured.clear()
    rows = points.complete(points.collect("level", [*keys[:2], ("c", "m", "s")], measure, tmp_path))
    assert measured == [("c", "m", "s")]
    assert [r["case"] for r in rows] == ["a", "b", "c"]
    assert str(points.read(tmp_path / "accuracy_vs_speed_level.csv")) == str(rows)
    for other, fresh in (("def", False), ("def", True), ("x-dirty", False), ("x-dirty", False)):
        measured.clear()
        monkeypatch.setattr(points, "commit", lambda other=other: other)
        points.collect("level", keys[:2], measure, tmp_path, fresh=fresh)
        assert measured == keys[:2], (other, fresh)


def test_front_has_what_no_other_beats_and_no_failures():
    rows = [
        row("c", "fast", "", 1.0, 1e-2),
        row("c", "beaten", "", 2.0, 2e-2),
        row("c", "failed once", "", 0.5, 1e-9, success=3),
        row("c", "exact", "", 3.0, 1e-9),
        row("c", "as exact, slower", "", 4.0, 1e-9),
        row("c", "failed throughout", "", np.nan, np.nan, success=0),
    ]
    assert [r["method"] for r in points.front(rows)] == ["fast", "exact"]


def test_no_point_lies_below_the_floor():
    look = Look({"m": ("red", "o", 5)}, lambda _: "m", lambda _: "", lambda _: "", 1.0)
    figure, axes = plt.subplots()
    draw_points(axes, [row("c", "m", "", 1.0, 1e-9), row("c", "m", "", 2.0, 1e-2)], look, floor=1e-6)
    below, above = axes.lines
    assert below.get_ydata()[0] == 1e-6
    assert above.get_ydata()[0] == 1e-2
    assert below.get_markeredgecolor() != above.get_markeredgecolor()
    plt.close(figure)


def test_ratios_say_whether_promises_are_met():
    rows = [
        row("velocity", "condensed", "rk4, 2 ms", 0.1, 1e-3),
        row("velocity", "condensed", "rk4, 0.5 ms", 0.3, 1e-4),
        row("velocity", MUJOCO, "40 links", 0.5, 0.4, ours=False),
        row("velocity", MUJOCO, "80 links", 2.0, 0.1, ours=False),
        row("velocity", MUJOCO, "90 links", 3.0, 0.01, ours=False, success=0),
        row("nominal", "default", "horizon 10, along_plan", 1e-3, 2e-3),
        row("nominal", DO_MPC, "horizon 10", 0.04, 1.5e-3, ours=False),
    ]
    mujoco, do_mpc = ratios.ratios(rows)
    # Of ours the most accurate that is ten times as fast as MuJoCo's most accurate that did not fail.
    assert (mujoco["ours"], mujoco["theirs"]) == ("condensed, rk4, 2 ms", f"{MUJOCO}, 80 links")
    assert (mujoco["faster"], mujoco["more_accurate"]) == pytest.approx((20.0, 100.0))
    assert mujoco["met"]
    assert (do_mpc["faster"], do_mpc["more_accurate"]) == pytest.approx((40.0, 0.75))
    assert not do_mpc["met"]
    assert "NOT MET: 50 times faster" in ratios.report([mujoco, do_mpc])


def test_a_family_is_beaten_only_if_every_point_of_it_is_by_another_family():
    rows = [
        row("one", "a", "x", 1.0, 1e-3),
        row("two", "a", "x", 1.0, 1e-3),
        row("one", "b", "x", 2.0, 1e-3),
        row("two", "b", "x", 2.0, 1e-2),
        row("one", "c", "x", 2.0, 1e-2),
        row("two", "c", "x", 0.5, 1e-2),
        row("one", "d", "x", 2.0, 1e-2, ours=False),
        # Failures neither beat nor save anybody.
        row("one", "e", "x", 0.1, 1e-9, success=3),
        row("one", "b", "y", 0.1, 1e-9, success=3),
    ]
    assert ratios.beaten(rows, lambda r: r["method"]) == {"b": "a"}
