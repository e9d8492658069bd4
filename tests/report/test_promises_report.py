"""What tables and the command line promise to print, to refuse and to write."""

import json
import math
from dataclasses import asdict, replace

import numpy as np
import pytest

from pcr_mpc import HoldMotors, load_scene, load_tuning, simulate
from pcr_mpc.cli import main
from pcr_mpc.cli import study as cli_study
from pcr_mpc.plant.statics.stability import assess_stability
from pcr_mpc.report.studies.choice import choice_record, choice_table
from pcr_mpc.report.studies.tuning import tuning_comments, tuning_table
from pcr_mpc.report.tables import (
    equilibria_table,
    equilibrium_record,
    equilibrium_table,
    summary_table,
    table,
    times_table,
)
from pcr_mpc.study.choice.choice import Choice, Measured
from pcr_mpc.study.choice.estimates import Estimate
from pcr_mpc.study.choice.rungs import all_physics
from pcr_mpc.study.episodes.spread import Spread
from pcr_mpc.study.tuning.score import Costs
from pcr_mpc.study.tuning.space import Search
from pcr_mpc.study.tuning.study import Chosen
from tests.conftest import CONTROLLERS, MODELS
from tests.run.test_promises_simulate import resting

PAIR = str(MODELS / "planar_pair.toml")
SCENES = MODELS / "scenes"


def row_of(text, name):
    return next(line for line in text.splitlines() if line.strip().startswith(name))


# --- tables -----------------------------------------------------------------------------------------------------------


def test_columns_are_aligned_the_first_to_the_left():
    assert table(("a", "bb"), [("long", "1"), ("x", "22222")]).splitlines() == [
        "a        bb", "----  -----", "long      1", "x     22222"]  # fmt: skip


def test_times_have_a_digit_below_a_hundred_microseconds_and_a_dash_for_none():
    text = times_table([("plant step", {"p50": 19.04, "p95": 99.94, "p99": 100.4, "max": 2000.6}, 1000.0),
                        ("  of it", dict.fromkeys(("p50", "p95", "p99", "max")), None)])  # fmt: skip
    assert row_of(text, "plant step").split()[2:] == ["19.0", "99.9", "100", "2001", "1000"]
    assert row_of(text, "of it").split()[2:] == ["-"] * 5


@pytest.fixture(scope="module")
def summary():
    """Of a run at rest, with figures made up, each another."""
    scene = resting()
    four = dict(zip(("p50", "p95", "p99", "max"), (11.0, 12.0, 13.0, 14.0), strict=True))
    return {
        **simulate(scene, scene.make_plant(), HoldMotors(2)).summary(),
        "rms_mm": 0.1234, "rms_after_1s_mm": 0.0567, "max_mm": 1.5, "final_error_mm": 0.25,
        "plant_step_us": four, "control_step_us": four, "control_cpu_us": four,
        "control_parts_us": {"linearise": four}, "solver_share": 0.256,
        "qp_iterations": {"p50": 15, "max": 40}, "peak_torque_Nm": 0.7654, "torque_limit_Nm": 1.5,
        "active_limits": {"rate": 3}, "control_steps": 250, "slack": {"torque": 0.01234}, "limit_violations": 4,
        "fallbacks": 5, "failures": 6, "control_rungs": {"solved": 245, "lqr": 5}, "rung": None, "need": None,
    }  # fmt: skip


def test_figures_of_a_run_stand_beside_their_names(summary):
    text = summary_table(summary)
    for name, value in (("RMS  ", "0.1234"), ("RMS after 1 s", "0.0567"), ("maximum", "1.5000"),
                        ("at the end", "0.2500"), ("limit violations", "4"), ("fall-backs", "5"),
                        ("failures", "6")):  # fmt: skip
        assert row_of(text, name).split()[-1] == value
    assert "26 % of the control steps' time" in text
    assert "p50 15, max 40" in text
    assert "0.765 N m (limit 1.5, soft)" in text
    assert "rate 3 of 250 periods" in text
    assert "torque 0.0123" in text


def test_what_a_run_has_nothing_of_is_said_so(summary):
    nothing = dict.fromkeys(("p50", "p95", "p99", "max"))
    text = summary_table({**summary, "rms_mm": None, "control_step_us": nothing, "solver_share": None,
                          "active_limits": {}, "slack": {}})  # fmt: skip
    assert "tracking error" not in text
    assert "control step " not in text
    assert row_of(text, "inside the solver").split()[3] == "-"
    assert row_of(text, "largest slack").split()[-1] == "none"
    assert "limits active in  0 of 250 periods" in text
    short = summary_table({**summary, "rms_after_1s_mm": None})
    assert row_of(short, "RMS after 1 s").split()[-1] == "-"


@pytest.mark.parametrize(
    ("known", "words"),
    [
        ({"verified": True}, "tip to 0.25 mm: within 0.12 mm; in time"),
        ({"verified": False}, "tip to 0.25 mm: not verified; see pcr-mpc choose; in time"),
        ({"plant_step_met": False}, "within 0.12 mm; plant step too slow"),
        ({"plant_step_met": False, "control_step_met": False}, "plant step too slow, control step too slow"),
    ],
)
def test_a_need_is_said_to_be_met_or_not(summary, known, words):
    need = {"tip_accuracy_mm": 0.25, "tip_error_mm": 0.123, "verified": True, "plant_step_met": True,
            "control_step_met": True, **known}  # fmt: skip
    rung = asdict(load_scene(SCENES / "payload.toml").plant)
    text = summary_table({**summary, "need": need, "rung": rung})
    assert words in text
    assert row_of(text, "rung").split(maxsplit=1)[1] == "inertia constant, rods as_built, payload carried"
    assert "another engine" in row_of(summary_table({**summary, "need": need}), "rung")


def test_a_choice_is_recorded_in_millimetres_and_microseconds():
    scene = load_scene(SCENES / "release.toml")
    rungs = all_physics(scene, 5e-4)
    errors, times, failures = (2e-6, math.inf, 1e-6, 0.0), (1e-5, math.nan, 3e-5, 4e-5), ("", "lost", "", "")
    physics = [Measured(*one) for one in zip(rungs, errors, times, failures, strict=True)]

    class Estimated:
        def of_level(self, ladder, level):
            return {"rods' inertia": Estimate(3e-3, "why")} if level == "none" else {}

        def step(self, *_):
            return Estimate(1e-7, "A")

        def rods(self, _):
            return Estimate(0.0, "exact")

    choice = Choice(scene, Estimated(), rungs[-1], {"air": Estimate(2e-7, "")}, 1e-7, [(rungs[1], "refused")], physics,
                    [physics[2]], 3e-4, physics[2])  # fmt: skip
    record = json.loads(json.dumps(choice_record(choice), allow_nan=False))
    assert record["need"] == pytest.approx({"tip_accuracy_mm": 0.002, "plant_step_us": 1e3, "control_step_us": 1e4})
    assert record["yardstick"]["step_error_mm"] == pytest.approx(1e-4)
    assert record["yardstick_lacks_mm"] == pytest.approx({"air": 2e-4})
    assert record["estimates"][0]["mm"] == pytest.approx(3.0)
    assert [one["error_mm"] for one in record["physics"]] == [pytest.approx(2e-3), None, pytest.approx(1e-3), 0.0]
    assert [one["step_us"] for one in record["physics"]] == [*map(pytest.approx, (10, None, 30, 40))]
    assert [one["failure"] for one in record["physics"]] == [None, "lost", None, None]
    assert record["control_step_us"] == pytest.approx(300.0)
    assert record["chosen"]["tip_error_mm"] == pytest.approx(1e-3 + 3e-4)
    text = choice_table(choice)
    for words in ("twice that step changes 0.0001 mm", "it lacks air: 0.0002 mm", "inertia constant: refused",
                  "the best of them is off by 0.0023 mm", "plant step 30 us (at most 1000)",
                  "control step 300 us (at most 10000)", "within 0.0013 mm, of which 0.0003 mm"):  # fmt: skip
        assert words in text
    assert "failed" in row_of(text, "inertia constant ")


def test_a_tuning_is_shown_beside_its_start():
    scene = load_scene(SCENES / "lemniscate.toml").tuned(load_tuning(CONTROLLERS / "default.toml"))
    costs, start = Costs(0.5, 0.01, 20.0, 300.0, 1.1, 0.25, 0.0), Costs(1.0, 0.02, 40.0, 250.0, 1.0, 0.5, 0.0)
    search = Search(scene, Spread(), 3, 7, "")
    chosen = Chosen(scene.tuning, 5, 0.61, 0.72, costs, start)
    text = tuning_table(search, chosen)
    assert row_of(text, "RMS under mismatch [mm]").split()[-2:] == ["0.5", "1"]
    assert row_of(text, "failed episodes [%]").split()[-2:] == ["25", "50"]
    assert row_of(text, "control step, CPU time [us]").split()[-2:] == ["300", "250"]
    assert "score 0.720 (0.610 in the search; default has 1" in text
    comments = "\n".join(tuning_comments(search, chosen, 20, "abc"))
    for words in ("Trial 5 of 20, each on 3 episodes", "seeds 7 to 9; code at abc", "seeds 10 to 15 (0.610",
                  "Score 0.720", "failed episodes [%]: 25, default 50"):  # fmt: skip
        assert words in comments


def test_an_equilibrium_is_recorded_whole(centre):
    record = json.loads(json.dumps(equilibrium_record(centre)))
    for name in ("p", "q", "force", "dforce_dp", "dforce_dq", "motor_torque", "rod_forces", "stiffness_eigenvalues"):
        assert record[name] == getattr(centre, name).tolist(), name
    for name in ("energy", "stable", "residual_norm", "iterations", "converged", "mode", "method", "drift"):
        assert record[name] == getattr(centre, name), name
    assert record["unstable_rods"] == []
    assert "verdict" in equilibrium_table(centre)
    assert row_of(equilibrium_table(centre), "verdict").split() == ["verdict", "stable"]
    assert "UNSTABLE (rods [1])" in equilibrium_table(replace(centre, unstable_rods=(1,)))


# --- the command line -------------------------------------------------------------------------------------------------


def test_every_equilibrium_is_listed_with_its_verdict(tmp_path, capsys):
    picture = tmp_path / "new" / "all.png"
    command = ["statics", PAIR, "--p", "0.18", "0.12", "--q", "3.0", "0.2", "--equilibria", "--picture", str(picture)]
    assert main([*command, "--json"]) == 0
    records = json.loads(capsys.readouterr().out)
    assert len(records) > 1
    assert picture.stat().st_size > 10_000
    for one in records:
        assert one["p"] == pytest.approx([0.18, 0.12])
        assert one["q"] == pytest.approx([3.0, 0.2])
        assert one["stable"] == (one["unstable_directions"] == 0)
    energies = [one["energy"] for one in records]
    assert energies == sorted(energies)
    assert main(command) == 0
    text = capsys.readouterr().out
    assert len(text.splitlines()) == len(records) + 2
    for number, (one, line) in enumerate(zip(records, text.splitlines()[2:], strict=True), start=1):
        assert line.startswith(f"{number} {one['mode']}")
        assert ("unstable" not in line) == one["stable"]
        assert f"{one['energy']:.4f}" in line


def test_a_table_of_equilibria_is_that_of_their_stability(centre):
    line = equilibria_table([centre]).splitlines()[2]
    assert f"{assess_stability(centre).stiffness_eigenvalues[0]:.4g}" in line
    assert "(0.0000, 0.2500)" in line


def test_a_force_is_carried_where_p_or_q_is_found(capsys):
    """Inverse: the rods carry the force; forward: so they do, and the motors stay."""
    assert main(["statics", PAIR, "--p", "0", "0.25", "--mode", "LR", "--force", "0.5", "-1", "--json"]) == 0
    inverse = json.loads(capsys.readouterr().out)
    assert inverse["force"] == pytest.approx([0.5, -1.0], abs=1e-7)
    assert inverse["p"] == pytest.approx([0.0, 0.25])
    assert main(["statics", PAIR, "--q", "3.3", "-0.2", "--force", "0.5", "-1", "--json"]) == 0
    forward = json.loads(capsys.readouterr().out)
    assert forward["force"] == pytest.approx([0.5, -1.0], abs=1e-7)
    assert forward["q"] == pytest.approx([3.3, -0.2])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["statics", PAIR, "--p", "0", "0.25", "--method", "closed_form"], "--method goes with both --p and --q"),
        (["statics", PAIR, "--q", "3", "0", "--mode", "LR"], "--mode goes with --p alone"),
        (["statics", PAIR, "--p", "0", "0.25", "--q", "3", "0", "--mode", "LR"], "--mode goes with --p alone"),
        (["statics", PAIR, "--p", "0", "0.25", "--q", "3", "0", "--force", "1", "0"], "--force goes with --p alone"),
        (["track", str(SCENES / "release.toml"), "--controller", str(CONTROLLERS / "lqr.toml")], "nothing to track"),
        (["track", str(SCENES / "release.toml"), "--links", "9"], "--links goes with --plant mujoco"),
        (["track", str(SCENES / "release.toml"), "--plant", "mujoco", "--method", "closed_form"], "no use with"),
        (["timing", str(SCENES / "release.toml"), "--steps", "0"], "--steps is 0, expected at least 1"),
        (["choose", str(SCENES / "lemniscate.toml")], "lemniscate states no need"),
        (["tune", str(SCENES / "lemniscate.toml"), "--jobs", "0"], "--jobs is 0, expected at least 1"),
        (["tune", str(SCENES / "lemniscate.toml"), "--episodes", "0"], "--episodes is 0, expected at least 1"),
    ],
)  # fmt: skip
def test_options_that_do_not_go_together_are_named(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 1
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.out == ""
    assert not list(tmp_path.rglob("*.*"))  # nothing is written


def test_tune_takes_storage_seed_period_and_episodes_from_its_options(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    searches = []
    monkeypatch.setattr(cli_study, "tune", lambda search, trials, executor, **_: searches.append((search, trials)))
    monkeypatch.setattr(cli_study, "finished_trials", lambda _: [{"trial": 0, "score": 1.0, **asdict(
        Costs(1.0, 0.1, 10.0, 100.0, 1.0, 0.0, 0.0))}])  # fmt: skip
    scene = str(SCENES / "lemniscate.toml")
    assert main(["tune", scene, "--storage", "sqlite:///x.db", "--keep-period", "--seed", "5", "--episodes", "3",
                 "--trials", "7", "--json", "--out", "a.toml"]) == 0  # fmt: skip
    record = json.loads(capsys.readouterr().out)
    assert (record["storage"], record["chosen"], record["trials"]) == ("sqlite:///x.db", None, 1)
    assert main(["tune", scene, "--out", "b.toml"]) == 0
    (given, trials), (default, usual) = searches
    assert (given.storage, given.keep_period, given.seed, given.episodes, trials) == ("sqlite:///x.db", True, 5, 3, 7)
    assert (default.keep_period, default.seed, default.episodes, usual) == (False, 0, 24, 50)
    assert default.storage.startswith("sqlite:///")
    assert "results" in default.storage
    assert given.scene.plant.integrator == "velocity_verlet"


@pytest.mark.parametrize(("words", "said"), [((), "interrupted"), (("rows are kept",), "rows are kept")])
def test_an_interrupt_has_its_own_status(words, said, monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt(*words)

    monkeypatch.setattr(cli_study, "choose", interrupted)
    assert main(["choose", str(SCENES / "vertical.toml")]) == 130
    assert capsys.readouterr().err == f"pcr-mpc: {said}\n"


def test_seeds_reach_the_noise(tmp_path, capsys, monkeypatch):
    """Another seed, another run; the record says which."""
    scene = replace(load_scene(SCENES / "sensors.toml"), duration=0.05)
    monkeypatch.setattr("pcr_mpc.cli.track.load_scene", lambda path: scene)
    hashes = []
    for seed in ("3", "4"):
        assert (
            main(
                [
                    "track",
                    str(SCENES / "sensors.toml"),
                    "--seed",
                    seed,
                    "--out",
                    str(tmp_path / seed),
                    "--no-pictures",
                    "--json",
                ]
            )
            == 0
        )
        summary = json.loads(capsys.readouterr().out)
        assert summary["seed"] == int(seed)
        hashes.append(summary["run_hash"])
        assert not np.isnan(np.load(tmp_path / seed / "run.npz")["x"]).any()
    assert len(set(hashes)) == 2
