"""Strain of rods: the closed form against finely integrated rods, its gradients, and the controller that knows it."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pcr_mpc import (
    MATERIALS,
    PCRError,
    Plant,
    all_equilibria,
    check_scene,
    inverse_statics,
    load_robot,
    load_scene,
    make_controller,
    simulate,
    solve_statics,
    summary_table,
)
from pcr_mpc.cli import main
from pcr_mpc.linearisation.pose_limits import LimitWatch, PoseLimits
from tests.conftest import MODELS

HALF = 0.4e-3


def thick(robot, half_thickness=HALF, limit=0.0085):
    ratios = [half_thickness and half_thickness / rod.length for rod in robot.rods]
    pairs = zip(robot.rods, ratios, strict=True)
    return replace(robot, rods=tuple(replace(rod, thickness_ratio=h, strain_limit=limit) for rod, h in pairs))


def integrated(rod, eq, i, points=2001):
    """Strain along rod i of an equilibrium by SciPy's DOP853, from what its base and its tip feel; SI units."""
    n = eq.rod_forces[i]
    lengths = np.linspace(0.0, rod.length, points)
    knots = np.linspace(0.0, rod.length, len(rod.stiffness_factors))
    at_rest = np.linspace(0.0, rod.length, len(rod.curvatures))
    gravity, compliance = np.array(eq.robot.gravity), 1.0 / rod.axial_stiffness

    def stiffness(s):
        return rod.bending_stiffness * np.interp(s, knots, rod.stiffness_factors)

    def force(s):  # weight of what hangs beyond s
        return n[:, None] + rod.line_density * gravity[:, None] * (rod.length - np.atleast_1d(s))

    def slopes(s, y):
        (n_x,), (n_y,) = force(s)
        theta, m = y
        stretch = 1 + compliance * (n_x * np.cos(theta) + n_y * np.sin(theta))
        bend = m / stiffness(s) + np.interp(s, at_rest, rod.curvatures)
        return [bend, stretch * (n_x * np.sin(theta) - n_y * np.cos(theta))]

    start = [eq.q[i], -eq.motor_torque[i]]
    found = solve_ivp(slopes, (0, rod.length), start, "DOP853", lengths, rtol=1e-11, atol=1e-13, max_step=0.01)
    theta, m = found.y
    n_x, n_y = force(lengths)
    stretch = compliance * (n_x * np.cos(theta) + n_y * np.sin(theta))
    return np.abs(stretch) + rod.half_thickness * np.abs(m / stiffness(lengths))


@pytest.fixture(scope="module")
def strip(pair):
    return thick(pair)


@pytest.fixture(scope="module")
def strained(strip):
    """Poses with the largest strain at the clamp, within the rod, and of rods that are nearly straight."""
    rng, found = np.random.default_rng(11), []
    while len(found) < 30:
        try:
            q = np.array([3.37, -0.23]) + rng.uniform(-1.2, 1.2, 2)
            found.append(solve_statics(strip, [0.0, 0.25] + rng.uniform(-0.1, 0.1, 2), q))
        except PCRError:
            continue
    return [*found, *all_equilibria(strip, (0.18, 0.12), (0.0, np.pi)), solve_statics(strip, (0.0, 0.385), (1.8, 1.3))]


def test_closed_form_is_the_largest_of_an_integrated_rod(strip, strained):
    inside = 0
    for eq in strained:
        for i, rod in enumerate(strip.rods):
            along = integrated(rod, eq, i)
            assert eq.max_strain[i] == pytest.approx(along.max(), rel=2e-5)  # samples miss the peak by that
            assert eq.max_strain[i] >= along.max() * (1 - 1e-8)
            inside += 0 < along.argmax() < len(along) - 1
    assert 20 < inside < 2 * len(strained) - 8  # both branches of the formula were asked


def test_strain_along_is_that_of_an_integrated_rod(strip, strained):
    for eq in strained[::8]:
        for i, rod in enumerate(strip.rods):
            assert eq.strain(101)[i] == pytest.approx(integrated(rod, eq, i, 101), rel=1e-6, abs=5e-8)


def test_other_methods_find_the_same(strip, strained):
    for eq in strained[:5]:
        other = solve_statics(strip, eq.p, eq.q, method="multiple_shooting", guess=eq)
        assert other.max_strain == pytest.approx(eq.max_strain, rel=1e-5)


def test_strain_at_the_clamp_is_the_torque(strip, centre):
    """Far out the moment falls from the clamp on; at the centre pose it first grows a little."""
    out = solve_statics(strip, (0.0, 0.3), centre.q)
    assert out.max_strain == pytest.approx(HALF * np.abs(out.motor_torque) / strip.stiffnesses)
    eq = solve_statics(strip, centre.p, centre.q)
    assert (eq.max_strain > 1.005 * HALF * np.abs(eq.motor_torque) / strip.stiffnesses).all()
    assert eq.overstrained == ()
    assert solve_statics(thick(strip, limit=0.005), centre.p, centre.q).overstrained == (0, 1)


def test_a_rod_bent_to_a_circle(pair):
    """Pure bending by kappa = 1/R strains a strip of thickness t by t / 2R; a tip with no force has no moment."""
    curved = thick(replace(pair, rods=tuple(replace(rod, curvature=5.0) for rod in pair.rods)))
    eq = solve_statics(curved, (0.0, 0.25), (2.9, -0.3))
    i = 0
    kappa = np.diff(np.unwrap(np.arctan2(*np.diff(eq.shape(4001)[i], axis=0).T[::-1]))) / (0.4 / 4000)
    assert eq.max_strain[i] == pytest.approx(HALF * np.abs(kappa - 5.0).max(), rel=1e-3)


@pytest.mark.parametrize("which", [0, 1])
def test_rods_of_every_kind_against_an_integrated_rod(general, bent, which):
    """Weight, curvature at rest, varying stiffness and stretch at once."""
    robot = thick(general)
    eq = solve_statics(robot, bent.p, bent.q, segments=16)
    along = integrated(robot.rods[which], eq, which)
    assert eq.max_strain[which] == pytest.approx(along.max(), rel=2e-5)
    assert eq.strain(101)[which] == pytest.approx(integrated(robot.rods[which], eq, which, 101), rel=1e-5, abs=1e-8)


def test_what_is_not_known_is_nan(pair, centre):
    half = replace(pair, rods=(thick(pair, None, math.inf).rods[0], thick(pair).rods[1]))
    eq = solve_statics(half, centre.p, centre.q)
    assert math.isnan(eq.max_strain[0])
    assert eq.max_strain[1] > 0.005
    assert np.isnan(eq.strain(5)[0]).all()
    assert eq.overstrained == ()


# --- the controller ---------------------------------------------------------------------------------------------------


def gradients(robot, pose, **settings):
    """Rows of the watch at a pose, and their values and slopes by the public statics."""
    limit = 0.001
    watch = LimitWatch(PoseLimits(strain=limit), Plant(robot, **settings))
    x = np.concatenate([pose.p, [0.3, -0.2], pose.q])
    watch.reset(x, pose)
    rows = watch.rows(x)
    h, slopes = 2e-6, np.zeros((2, 6))
    for j in (0, 1, 4, 5):
        ends = []
        for sign in (1, -1):
            at = x.copy()
            at[j] += sign * h
            ends.append(solve_statics(robot, at[:2], at[4:], guess=pose).max_strain / limit)
        slopes[:, j] = (ends[0] - ends[1]) / (2 * h)
    return rows, rows.upper - rows.C @ x, 1.0 - pose.max_strain / limit, slopes


def test_rows_are_values_and_gradients(strip, strained):
    for pose in strained[:12]:
        rows, slack, expected, slopes = gradients(strip, pose)
        assert rows.kinds == ("strain", "strain")
        assert rows.scale.tolist() == [0.001, 0.001]
        assert np.isneginf(rows.lower).all()
        assert slack == pytest.approx(expected, abs=1e-7)
        assert rows.C == pytest.approx(slopes, abs=1e-5 * np.abs(slopes).max())


def test_rows_of_rods_that_are_not_plain(general, bent):
    robot = thick(general)
    pose = solve_statics(robot, bent.p, bent.q)
    rows, slack, expected, slopes = gradients(robot, pose)
    assert slack == pytest.approx(expected, abs=1e-4)
    assert rows.C == pytest.approx(slopes, abs=2e-3 * np.abs(slopes).max())


def test_strain_is_watched_where_it_is_near_and_known(pair, strip, centre):
    unknown, x = thick(pair, None, math.inf), np.concatenate([centre.p, [0, 0], centre.q])
    strain = float(solve_statics(strip, centre.p, centre.q).max_strain.max())
    for robot, limit, near in ((strip, strain / 0.79, False), (strip, strain / 0.81, True), (unknown, 1e-6, False)):
        watch = LimitWatch(PoseLimits(strain=limit), Plant(robot))
        watch.reset(x, centre)
        assert (watch.rows(x) is not None) == near
        assert watch.combinations() == ([("strain", "strain")] if robot is strip else [])
    one = LimitWatch(PoseLimits(strain=(math.inf, 0.001)), Plant(strip))
    one.reset(x, centre)
    assert one.rows(x).kinds == ("strain",)


def test_far_agrees_with_rows(strip, strained):
    """What is called far has no rows, at any pose."""
    far = 0
    for pose in strained[:30]:
        x = np.concatenate([pose.p, [0, 0], pose.q])
        watch = LimitWatch(PoseLimits(strain=0.0085), Plant(strip))
        watch.reset(x, pose)
        state = Plant(strip)
        state.reset(x, pose)
        shapes = state.rods(x[:2], x[4:]).unknowns[:2].ravel().tolist()
        if watch.far([1.0, 0.0, 0.0, *shapes]):
            far += 1
            assert watch.rows(x) is None
    assert 2 < far < 28


@pytest.fixture(scope="module")
def swing():
    """The first second of the lemniscate, whose rods are strained by 0.66 %."""
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml")
    scene = replace(scene, robot=thick(scene.robot), duration=1.2)
    return replace(scene, pose_limits=replace(scene.pose_limits, strain=None))


def test_strain_is_kept_in_closed_loop(swing):
    limit = 0.0062
    scene = replace(swing, robot=thick(swing.robot, limit=limit))
    free = simulate(scene, scene.make_plant(), make_controller(scene))
    assert free.peak_strain > 0.0064
    kept = replace(scene, pose_limits=replace(scene.pose_limits, strain=limit))
    found = simulate(kept, kept.make_plant(), make_controller(kept))
    assert found.peak_strain < limit * 1.002
    assert found.summary()["active_limits"]["strain"] > 10
    assert found.summary()["limit_violations"] == 0
    assert found.verdict() == ""
    # What was not kept is told, where and by how much.
    event = free.overstrained()[0]
    assert event["kind"] == "strain"
    assert f"{100 * free.peak_strain:.3g} %" in " ".join(one["message"] for one in free.overstrained())
    strains = free.strains.max(axis=1)
    assert event["t"] == pytest.approx(np.flatnonzero(strains > limit * 1.001)[0] * scene.period)
    assert free.pose_violations()["strain"] == np.count_nonzero(strains > limit * 1.001)
    summary = free.summary()
    assert (summary["peak_strain"], summary["strain_limit"]) == (free.peak_strain, limit)
    assert event in summary["events"]
    text = summary_table(summary)
    assert f"largest strain    {100 * free.peak_strain:.3f} % (limit 0.62 %, soft)" in text
    assert event["message"] in text


def test_a_reference_that_strains_too_much_is_told_before(swing):
    assert check_scene(swing) == []
    scene = replace(swing, robot=thick(swing.robot, limit=0.006))
    (line,) = check_scene(scene)
    assert line.startswith("the reference strains rod 0 by 0.66")
    assert "bears 0.6 %" in line
    assert "at t = " in line


@pytest.mark.parametrize("path", sorted((MODELS / "scenes").glob("*.toml")), ids=lambda path: path.stem)
def test_shipped_robots_could_be_built(path):
    """Where each scene begins, with some way to go; `check_scene` looks at its way, when the scene is run."""
    scene = load_scene(path)
    eq = scene.start()
    assert np.isfinite(scene.robot.strain_limits).all()
    assert (eq.max_strain < 0.85 * scene.robot.strain_limits).all()
    for rod in scene.robot.rods:  # nothing is promised of the material that nobody sells
        assert rod.strain_limit in {material.strain_limit for material in MATERIALS.values()}


def test_limits_of_a_scene(tmp_path):
    """Rods that know their material bring its limit along; a scene may have its own, or none."""
    robot = (MODELS / "rfrfr.toml").read_text(encoding="utf-8")
    robot = robot.replace("bending_stiffness = 0.15707963267948966", 'material = "spring_steel"\ndiameter = 2e-3')
    robot = robot.replace("line_density = 0.024662", "density = 7851.0")
    (tmp_path / "r.toml").write_text(robot, encoding="utf-8")
    text = (MODELS / "scenes" / "release.toml").read_text(encoding="utf-8").replace("../planar_pair.toml", "r.toml")
    text = text.replace("tip = [0.0, 0.25]", "tip = [0.0, 0.8]")

    def limits(add=""):
        path = tmp_path / "s.toml"
        path.write_text(text + add, encoding="utf-8")
        return load_scene(path)

    steel = MATERIALS["spring_steel"].strain_limit
    assert limits().pose_limits.strain == (steel, steel)
    assert limits("\n[limits]\nstrain = 0.004\n").pose_limits.strain == 0.004
    assert limits("\n[limits]\nstrain = 0.004\n").strain_limits.tolist() == [0.004] * 2
    off = limits("\n[limits]\nstrain = 0\n")
    assert off.pose_limits.strain is None
    assert off.strain_limits.tolist() == [steel] * 2  # still told
    with pytest.raises(PCRError, match="not per cent"):
        limits("\n[limits]\nstrain = 0.5\n")
    (tmp_path / "r.toml").write_text((MODELS / "rfrfr.toml").read_text(encoding="utf-8"), encoding="utf-8")
    assert limits().pose_limits.strain is None
    with pytest.raises(PCRError, match="no rod of rfrfr has a section"):
        limits("\n[limits]\nstrain = 0.004\n")


# --- the command line -------------------------------------------------------------------------------------------------


def test_statics_tells_the_strain(tmp_path, capsys):
    text = (MODELS / "rfrfr.toml").read_text(encoding="utf-8").replace("line_density", "diameter = 4e-3\nline_density")
    path = tmp_path / "r.toml"
    path.write_text(text.replace("diameter", "strain_limit = 0.007\ndiameter"), encoding="utf-8")
    assert main(["statics", str(path), "--p", "0", "0.4", "--mode", "LR", "--json"]) == 0
    out, err = capsys.readouterr()
    record = json.loads(out)
    assert record["strain_limit"] == [0.007, 0.007]
    assert record["overstrained"] == [0, 1]
    eq = inverse_statics(load_robot(path), record["p"], mode="LR")
    assert record["max_strain"] == pytest.approx(eq.max_strain.tolist())
    assert err.count("pcr-mpc: warning: rod") == 2
    assert main(["statics", str(path), "--p", "0", "0.4", "--mode", "LR"]) == 0
    assert f"largest strain [%]        {100 * eq.max_strain[0]:.4g} of 0.7, " in capsys.readouterr().out
    assert main(["statics", str(MODELS / "rfrfr.toml"), "--p", "0", "0.4", "--mode", "LR", "--json"]) == 0
    out, err = capsys.readouterr()
    assert json.loads(out)["max_strain"] == [None, None]
    assert err == ""
