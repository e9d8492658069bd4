"""Numbers of robots from logs of their motion: against the robots that moved, differences and closed forms."""

import csv as csv_module
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import Plant, load_robot, load_scene, rollout
from pcr_mpc.cli import main
from pcr_mpc.errors import IdentificationError, LogError
from pcr_mpc.plant.uncertainty import load_uncertainty
from pcr_mpc.study.identification.balance import imbalance
from pcr_mpc.study.identification.first_guess import first_guess, pieces_of
from pcr_mpc.study.identification.identify import identify
from pcr_mpc.study.identification.logs.checks import checked_log, delay_in_angles
from pcr_mpc.study.identification.logs.log import Log, read_log
from pcr_mpc.study.identification.parameters import catalogue, chosen
from pcr_mpc.study.identification.prediction import Predictor
from pcr_mpc.study.identification.problem import Noise, Problem
from pcr_mpc.study.identification.residuals import whiteness
from tests.conftest import MODELS, ROOT

DATA = ROOT / "tests" / "data" / "identification"
STEP, ROWS, DELAY = 0.01, 120, 0.013  # s; the delay is 1.3 periods
FORCE = (0.3, -0.4)
TRUE = {"stiffness": (0.047, 0.0535), "base": ((-0.1006, 0.0004), (0.0997, -0.0003)), "mass": 0.27, "drag": 0.25}


@pytest.fixture(scope="module")
def scene():
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml")
    return replace(scene, plant=replace(scene.plant, integrator="rk4", dt=1e-3))


@pytest.fixture(scope="module")
def true_robot(scene):
    rods = tuple(
        replace(rod, bending_stiffness=stiffness, base=base)
        for rod, stiffness, base in zip(scene.robot.rods, TRUE["stiffness"], TRUE["base"], strict=True)
    )
    return replace(scene.robot, rods=rods, tip_mass=TRUE["mass"], drag=TRUE["drag"])


def commanded():
    t = STEP * np.arange(ROWS)
    return np.stack([1.6 * np.sin(7.0 * t) + np.sin(17.0 * t), 1.5 * np.cos(9.0 * t) - np.sin(13.0 * t)], axis=1)


@pytest.fixture(scope="module")
def log(scene, true_robot):
    """What a robot did, moved step by step of a millisecond, in which the commands' delay is whole."""
    late, pose, u = round(DELAY / 1e-3), scene.start(), commanded()
    held = np.repeat(u, 10, axis=0)
    applied = np.concatenate([np.tile(u[0], (late, 1)), held])[: len(held)]
    plant = Plant(true_robot, integrator="rk4", dt=1e-3)
    x0 = np.concatenate([pose.p + (2e-3, 1e-3), (0.05, -0.02), pose.q + (0.01, -0.02)])
    x = rollout(plant, x0, applied, FORCE, guess=pose).x[::10][:ROWS]
    return Log("synthetic", STEP, STEP * np.arange(ROWS), x[:, :2], x[:, 4:], u)


@pytest.fixture(scope="module")
def weighed(scene, log):
    return identify(scene, [log], fixed={"tip_mass": TRUE["mass"]})


def noisy(log, seed=0, tip=5e-5, angle=1.534e-3):
    rng = np.random.default_rng(seed)
    p = log.p + rng.normal(0.0, tip, log.p.shape)
    return replace(log, p=p, q=angle * np.round(log.q / angle))


def truth():
    values = {"drag": TRUE["drag"], "delay": 1.3, "force_x": FORCE[0], "force_y": FORCE[1]}
    for i in range(2):
        values[f"rods[{i}].bending_stiffness"] = TRUE["stiffness"][i]
        values |= {f"rods[{i}].base_{axis}": TRUE["base"][i][j] for j, axis in enumerate("xy")}
    return values


def test_every_number_is_recovered_without_noise(weighed):
    found = {one.name: one.value for one in weighed.estimates}
    assert set(found) == set(truth())
    for name, value in truth().items():
        assert found[name] == pytest.approx(value, rel=1e-6, abs=1e-7 if "base" in name else 0.0), name
    assert weighed.unidentified == ()
    assert all(one.told == "data" for one in weighed.estimates)
    assert weighed.method == "whole runs"
    assert weighed.fits[0].rms() < 1e-8
    assert weighed.fits[0].rms(before=True) > 1e-3


def test_the_scale_that_motion_cannot_tell_is_named(scene, log):
    found = identify(scene, [noisy(log)])
    [sentence] = found.unidentified
    for name in ("bending_stiffness of both rods", "tip_mass", "drag", "force", "share one scale", "--fix tip_mass"):
        assert name in sentence
    assert found.estimate("rods[0].bending_stiffness").told == "prior"
    for one, other in (("rods[0].bending_stiffness", "tip_mass"), ("rods[1].bending_stiffness", "drag")):
        wanted = {**truth(), "tip_mass": TRUE["mass"]}
        ratio = found.estimate(one).value / found.estimate(other).value
        assert ratio == pytest.approx(wanted[one] / wanted[other], rel=0.03)
    # Their common scale is known as well as all that was believed of it together.
    precision = 2 / (0.1**2 / 3) + 1 / (0.2**2 / 3) + 3 / np.log(2.0) ** 2
    sd = found.estimate("tip_mass").sd / found.estimate("tip_mass").value
    assert sd == pytest.approx(precision**-0.5, rel=0.05)
    assert 0.8 < found.chi2_per_dof < 1.25
    assert found.whiteness.white
    assert found.fits[0].noise.tip == pytest.approx(5e-5, rel=0.15)


@pytest.mark.slow
def test_outliers_and_gaps(scene, log):
    rng = np.random.default_rng(5)
    p, q, u = noisy(log, 1).p.copy(), noisy(log, 1).q.copy(), log.u.copy()
    p[rng.choice(ROWS, 8, replace=False)] += rng.normal(0.0, 0.05, (8, 2))
    p[60:75] = np.nan
    q[90:100, 1] = np.nan
    u[[40, 41, 110]] = np.nan
    found = identify(scene, [replace(log, p=p, q=q, u=u)], fixed={"tip_mass": TRUE["mass"]})
    assert found.loss == "huber"
    assert found.fits[0].outliers >= 6
    for one in found.estimates:
        assert abs(one.value - truth()[one.name]) < 4.5 * one.sd, one
        assert one.told == "data" or "force" in one.name, one
    lines = " ".join(found.warnings)
    assert "outliers" in lines
    assert "6 missing commands" in lines


def test_jacobian_against_differences(scene, log):
    u, start = log.u.copy(), scene.start()
    u[30], u[50, 1] = np.nan, np.nan
    short = replace(log, u=u).part(0, 70)
    predictor = Predictor(scene, [short])
    words = ("default", "motor_zero", "tip_offset", "length")
    parameters = chosen(scene.robot, catalogue(scene.robot, 1, 1.37, 3.0), free=words)
    pieces = pieces_of([short], [3], 0.3)
    assert len(pieces) == 2
    around = first_guess(predictor, scene.robot, pieces, 1.37, len(parameters.free))
    problem = Problem(predictor, parameters, pieces, [Noise(1e-4, 1e-3)], around, joint=1.0)
    vector = problem.packed(replace(around, z=np.linspace(-0.3, 0.4, len(parameters.free))))
    residuals, jacobian = problem.linearised(vector)
    assert jacobian.shape == (len(residuals), 2 * 6 + 3 + len(parameters.free))
    h = 1e-4
    rng = np.random.default_rng(0)
    for i in [*rng.choice(12, 3, replace=False), 12, 13, *range(15, len(vector), 2), len(vector) - 1]:
        ahead, behind = (problem.linearised(vector + side * h * np.eye(len(vector))[i])[0] for side in (1, -1))
        wanted = (ahead - behind) / (2 * h)
        assert jacobian[:, i] == pytest.approx(wanted, abs=2e-4 * np.abs(wanted).max()), i
    assert start.mode == "LR"


def changed(log, **changes):
    return replace(log, **{name: change(getattr(log, name)) for name, change in changes.items()})


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"p": lambda p: 1e3 * p}, "millimetres"),
        ({"p": lambda p: 1e2 * p}, "centimetres"),
        ({"q": np.degrees, "u": np.degrees}, "degrees"),
        ({"q": np.degrees}, "degrees"),
        ({"u": np.degrees}, "degrees per second"),
        ({"u": lambda u: u * 60 / (2 * np.pi)}, "turns per minute"),
        ({"u": lambda u: -u}, "sign"),
        ({"step": lambda step: 1e3 * step, "t": lambda t: 1e3 * t}, "milliseconds"),
        ({"p": lambda p: p + (1.0, 0.0)}, "another robot's"),
        ({"q": lambda q: q + 2.5}, "stops"),
    ],
)
def test_wrong_units_are_noticed(scene, log, changes, words):
    with pytest.raises(LogError, match=words):
        checked_log(changed(log, **changes), scene.robot, scene.start())


def test_logs_that_are_too_short_or_still(scene, log):
    with pytest.raises(LogError, match=r"too short: 0\.19 s with 20 tip positions"):
        identify(scene, [log.part(0, 20)])
    still = changed(log, p=lambda p: p * 0 + p[0], q=lambda q: q * 0 + q[0], u=lambda u: 0 * u)
    with pytest.raises(LogError, match="nothing moves"):
        identify(scene, [still])


MIRRORED = {
    "tip": ({"p": lambda p: p * (-1.0, 1.0)}, "p_x_m had the other sign or if left and right of the motors"),
    "upside down": ({"p": lambda p: p * (1.0, -1.0) + (0.0, 0.5)}, "check geometry"),
    "motors": ({"q": lambda q: np.pi - q[:, ::-1], "u": lambda u: -u[:, ::-1]}, "p_x_m had the other sign or if left"),
    "counting": ({"q": lambda q: -q, "u": lambda u: -u}, "angles and rates had the other sign"),
}


@pytest.mark.parametrize("kind", MIRRORED)
def test_a_mirrored_log_is_refused_before_any_search(scene, log, kind, monkeypatch):
    """Units, angles and reach are possible, the motion is not; by statics at some of its poses."""
    monkeypatch.setattr("pcr_mpc.study.identification.identify.search", lambda *_, **__: pytest.fail("searched"))
    changes, words = MIRRORED[kind]
    with pytest.raises(IdentificationError, match=rf"hardly a log of planar_pair; .*{words}"):
        identify(scene, [noisy(changed(log, **changes))])


def test_numbers_that_are_far_off_are_no_mirror(scene, log):
    """Neither a stiffness that is three times another, nor fast swings, nor outliers and gaps."""
    p = noisy(log).p.copy()
    p[::40] += 0.03
    p[50:60] = np.nan
    for one in (log, noisy(log), replace(log, p=p)):
        for factor in (1 / 3, 1.0, 3.0):
            rods = tuple(replace(rod, bending_stiffness=factor * rod.bending_stiffness) for rod in scene.robot.rods)
            predictor = Predictor(scene, [one])
            off = imbalance(predictor, predictor.plant(0, replace(scene.robot, rods=rods)), one)
            assert off < 0.25, (factor, off)
    unseen = replace(log, q=log.q * (np.nan, 1.0))
    assert imbalance(predictor, predictor.plant(0, scene.robot), unseen) is None


def test_encoders_that_wrap(scene, log):
    wrapped = changed(log, q=lambda q: q - 2 * np.pi * np.ceil((q - 3.5) / (2 * np.pi)))
    assert np.abs(np.diff(wrapped.q, axis=0)).max() > 6.0
    assert checked_log(wrapped, scene.robot, scene.start()).q == pytest.approx(log.q, abs=1e-12)


def test_delay_in_angles(log):
    assert delay_in_angles(log) == pytest.approx(1.3, abs=0.011)


def test_words_for_parameters(scene):
    everything = catalogue(scene.robot, 1, 0.0, 2.0)
    assert len(chosen(scene.robot, everything, free=["base"]).free) == 4
    assert [one.name for one in chosen(scene.robot, everything, free=["rods[1].base"]).free] == [
        "rods[1].base_x",
        "rods[1].base_y",
    ]
    with pytest.raises(IdentificationError, match="did you mean 'tip_mass'"):
        chosen(scene.robot, everything, free=["tipmass"])
    with pytest.raises(IdentificationError, match="line_density cannot be free"):
        chosen(scene.robot, everything, free=["line_density"])
    with pytest.raises(IdentificationError, match="nothing is free"):
        chosen(scene.robot, everything, free=["drag"], fixed={"drag": 0.2})
    with pytest.raises(IdentificationError, match="drag cannot be held at -1"):
        chosen(scene.robot, everything, fixed={"drag": -1.0})


def test_whiteness_of_what_is_white_and_what_is_not():
    rng = np.random.default_rng(0)
    noise = rng.normal(size=600)
    assert whiteness([noise, rng.normal(size=600)]).white
    slow = np.convolve(noise, np.ones(5) / 5.0, mode="same")
    found = whiteness([slow])
    assert not found.white
    assert found.autocorrelation[0] == pytest.approx(0.8, abs=0.05)
    assert found.widening == pytest.approx(5.0, abs=1.5)


def write_csv(path, log, names=("t_s", "p_x_m", "p_y_m", "q0_rad", "q1_rad", "u0_rad_s", "u1_rad_s"), skip=()):
    rows = np.column_stack([log.t, log.p, log.q, log.u])
    lines = [",".join(names)]
    for k, row in enumerate(rows):
        if k not in skip:
            lines.append(",".join("" if np.isnan(value) else f"{value:.9g}" for value in row))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_csv_with_gaps(tmp_path, log):
    p = log.p.copy()
    p[7] = np.nan
    path = write_csv(tmp_path / "log.csv", replace(log, p=p), skip={20, 21, 50})
    [read] = read_log(path, 2)
    assert len(read.t) == ROWS
    assert read.step == pytest.approx(STEP, rel=1e-9)
    assert np.flatnonzero(np.isnan(read.p).any(axis=1)).tolist() == [7, 20, 21, 50]
    assert read.missing.tolist() == [20, 21, 50]
    kept = ~np.isnan(read.q)
    assert read.q[kept] == pytest.approx(log.q[kept], rel=1e-8)
    both = read_log(write_csv(tmp_path / "two.csv", log, skip=set(range(60, 90))), 2)
    assert [len(one.t) for one in both] == [60, 30]


def test_csv_that_is_none(tmp_path, log):
    path = tmp_path / "log.csv"
    path.write_text("time,x\n0,1\n")
    with pytest.raises(LogError, match="no column 't_s'"):
        read_log(path, 2)
    path.write_text("t_s,u0_rad_s,u1_rad_s\n0,1,1\n0.01,1,1\n")
    with pytest.raises(LogError, match="nothing of the tip"):
        read_log(path, 2)
    with pytest.raises(LogError, match="has 1 motors"):
        read_log(write_csv(path, log), 1)
    path.write_text("t_s,p_x_m,p_y_m,q0_rad\n0,1,1,1\n0.01,1,1,1\n0.025,1,1,1\n0.031,1,1,1\n")
    with pytest.raises(LogError, match="not at a uniform rate"):
        read_log(path, 2)
    path.write_text("t_s,p_x_m,p_y_m,q0_rad\n0,1,1,1\n0.01,nonsense,1,1\n")
    with pytest.raises(LogError, match="row 3, column 'p_x_m': 'nonsense'"):
        read_log(path, 2)


def test_the_command_writes_a_robot_that_a_later_call_believes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    csv = DATA / "ours_1.csv"
    scene = str(MODELS / "scenes" / "lemniscate.toml")
    assert main(["identify", scene, str(csv), "--out", "mine.toml", "--validate", str(csv), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert set(found) >= {"estimates", "delay", "chi2_per_dof", "unidentified", "files"}
    true = truth_of("ours_1.csv")
    for name, one in found["estimates"].items():
        assert abs(one["value"] - true[name]) < 4.0 * one["sd"], name
    assert found["delay"] == pytest.approx(1.0, abs=0.01)
    assert set(found["estimates"]["tip_mass"]) >= {"value", "sd", "prior", "unit", "told"}
    assert all((tmp_path / file).is_file() for file in found["files"].values())
    robot, known = load_robot("mine.toml"), load_uncertainty("mine.toml")
    assert robot.tip_mass == found["estimates"]["tip_mass"]["value"]
    assert robot.rods[0].strain_limit == load_robot(MODELS / "planar_pair.toml").rods[0].strain_limit
    assert robot.rods[1].base[0] == found["estimates"]["rods[1].base_x"]["value"]
    assert known.sd[known.names.index("tip_mass")] == pytest.approx(found["estimates"]["tip_mass"]["sd"], rel=1e-5)
    everything = catalogue(robot, 1, 0.0, 2.0)
    believed = chosen(robot, everything, uncertainty=known)
    sds = dict(zip(known.names, known.sd, strict=True))
    for one in believed.free:
        if one.name in sds:
            assert one.sd * (one.value if one.positive else 1.0) == pytest.approx(sds[one.name])
    correlation = np.linalg.inv(believed.root.T @ believed.root)
    first, mass = believed.index("rods[0].bending_stiffness"), believed.index("tip_mass")
    assert correlation[first, mass] > 0.99
    (tmp_path / "mine.toml").write_text((tmp_path / "mine.toml").read_text().replace("sd = [0", "sd = [-0"))
    assert main(["statics", "mine.toml", "--p", "0", "0.25"]) == 1
    assert "uncertainty.sd" in capsys.readouterr().err


def truth_of(name):
    with open(DATA / "truth.csv", newline="") as handle:
        row = next(row for row in csv_module.DictReader(handle) if row["log"] == name)
    return {key: float(value) for key, value in row.items() if key != "log"}


def test_a_recorded_log_with_gaps_and_outliers(scene):
    found = identify(scene, read_log(DATA / "ours_0_gaps.csv", 2))
    assert found.loss == "huber"
    assert found.fits[0].outliers == 4
    true = truth_of("ours_0_gaps.csv")
    for one in found.estimates:
        assert abs(one.value - true[one.name]) < 4.0 * one.sd, one


@pytest.mark.slow
def test_a_log_of_another_engines_robot(scene):
    """MuJoCo's links are not our rods; what is left is a hundredth of what was believed wrong."""
    heavy = replace(scene, plant=replace(scene.plant, inertia="condensed", dt=5e-3))
    found = identify(heavy, read_log(DATA / "mujoco_0.csv", 2))
    true = truth_of("mujoco_0.csv")
    assert found.fits[0].rms() < 0.05 * found.fits[0].rms(before=True)
    ratio = found.estimate("rods[0].bending_stiffness").value / found.estimate("tip_mass").value
    assert ratio == pytest.approx(true["rods[0].bending_stiffness"] / true["tip_mass"], rel=0.03)
    assert found.delay == pytest.approx(true["delay"], abs=0.05)


@pytest.mark.slow
def test_multiple_shooting_comes_to_the_same(scene, log, monkeypatch):
    whole = identify(scene, [noisy(log)], fixed={"tip_mass": TRUE["mass"]})
    monkeypatch.setattr("pcr_mpc.study.identification.search._GROWTH", 0.0)
    pieces = identify(scene, [noisy(log)], fixed={"tip_mass": TRUE["mass"]})
    assert "multiple shooting" in pieces.method
    for one, other in zip(whole.estimates, pieces.estimates, strict=True):
        assert one.value == pytest.approx(other.value, abs=0.1 * one.sd)
        assert one.sd == pytest.approx(other.sd, rel=0.1)


@pytest.mark.slow
def test_the_page_from_python(monkeypatch):
    page = (ROOT / "docs" / "identification.md").read_text(encoding="utf-8")
    [code] = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    monkeypatch.chdir(ROOT)
    names: dict = {}
    exec(code, names)
    stiffness = names["found"].estimate("rods[0].bending_stiffness")
    assert stiffness.value == pytest.approx(truth_of("ours_1.csv")["rods[0].bending_stiffness"], abs=4 * stiffness.sd)
    assert names["mine"].tip_mass == 0.295
    assert "tip_mass" not in names["known"].names
