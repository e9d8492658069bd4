"""The inertia of the rods in scenes, tunings and the closed loop."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, PlanLimits, load_scene, load_tuning, make_controller, plan_timing, simulate
from pcr_mpc.loop.demand.feed_forward import feed_forward
from tests.conftest import CONTROLLERS, MODELS


def edited(path, tmp_path, **keys):
    """The file with ``integrator`` and other keys of its [plant] or [model] table replaced or added."""
    text = path.read_text().replace("../..", str(MODELS.parent)).replace('"../', f'"{MODELS}/')
    for key, value in keys.items():
        table = "[plant]" if "[plant]" in text else "[model]"
        lines = [line for line in text.splitlines() if line.split("=")[0].strip() != key]
        at = next(i for i, line in enumerate(lines) if line.startswith(table))
        text = "\n".join([*lines[: at + 1], f'{key} = "{value}"', *lines[at + 1 :]])
    (tmp_path / path.name).write_text(text)
    return tmp_path / path.name


def test_scenes_and_tunings_say_which(tmp_path):
    release = MODELS / "scenes" / "release.toml"
    assert load_scene(MODELS / "scenes" / "lemniscate.toml").make_plant().inertia == "none"
    for inertia, integrator in (("condensed", "rk4"), ("full", "gauss")):
        scene = load_scene(edited(release, tmp_path, inertia=inertia, integrator=integrator))
        plant = scene.make_plant()
        assert (plant.inertia, plant.integrator) == (inertia, integrator)
    assert load_tuning(edited(CONTROLLERS / "default.toml", tmp_path, inertia="constant")).model.inertia == "constant"


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ({"inertia": "full", "integrator": "rk4"}, "plant.integrator: is rk4: inertia 'full' needs 'gauss'"),
        ({"inertia": "none", "integrator": "gauss"}, "plant.integrator: is gauss"),
        ({"inertia": "constant", "method": "single_shooting"}, "plant.inertia: is constant, which method"),
        ({"inertia": "some"}, "plant.inertia"),
    ],
)
def test_what_does_not_go_together_is_named(tmp_path, keys, problem):
    with pytest.raises(ModelError, match=problem.replace(".", r"\.")):
        load_scene(edited(MODELS / "scenes" / "release.toml", tmp_path, **keys))


def test_the_controller_wants_the_inertia_that_the_robot_has():
    """On the robot whose rods have mass a model with mass is three times better, on the one of the paper worse."""
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml")
    scene = replace(scene, duration=0.6, trajectory=replace(scene.trajectory, ramp=0.3))
    errors = {}
    for of_plant, integrator in (("none", "rk4"), ("condensed", "rk4"), ("full", "gauss")):
        plant = replace(scene.plant, inertia=of_plant, integrator=integrator, dt=2e-3)
        for of_model in ("none", "condensed"):
            tuning = replace(scene.tuning, model=replace(scene.tuning.model, inertia=of_model))
            case = replace(scene, plant=plant, tuning=tuning)
            run = simulate(case, case.make_plant(), make_controller(case))
            errors[of_plant, of_model] = np.sqrt((run.error[run.t > 0.2] ** 2).mean())
    assert errors["condensed", "condensed"] < 0.5 * errors["condensed", "none"]
    assert errors["none", "none"] < 0.5 * errors["none", "condensed"]
    for of_model in ("none", "condensed"):
        assert errors["full", of_model] == pytest.approx(errors["condensed", of_model], rel=0.02)


def test_the_feed_forward_carries_the_inertia_of_the_rods():
    """Open loop on rods of distributed mass; at 2 ms little is lost by the rates' being held over the periods."""
    scene = replace(load_scene(MODELS / "scenes" / "lemniscate.toml"), duration=0.4, period=2e-3)
    scene = replace(scene, plant=replace(scene.plant, inertia="full", integrator="gauss", dt=2e-3))
    tuning = load_tuning(CONTROLLERS / "open_loop.toml")
    errors = {}
    for inertia in ("none", "condensed"):
        controller = make_controller(scene, replace(tuning, model=replace(tuning.model, inertia=inertia)))
        errors[inertia] = simulate(scene, scene.make_plant(), controller).summary()["rms_mm"]
    # Without M_pq it would be 0.005 mm, with dT/dp twice 0.001 mm.
    assert errors["condensed"] < 4e-4 < 0.01 < errors["none"]


@pytest.mark.slow
def test_heavy_rods_are_driven_better_by_a_model_that_knows_their_inertia():
    """Both by multiple shooting, for heavy rods sag."""
    scene = replace(load_scene(MODELS / "scenes" / "heavy_rods.toml"), duration=0.3)
    shooting = replace(scene.plant, method="multiple_shooting", weight="exact", inertia="condensed", segments=4)
    scene = replace(scene, plant=replace(shooting, integrator="velocity_verlet", dt=2e-3))
    errors = {}
    for inertia in ("none", "condensed"):
        tuning = replace(scene.tuning, model=replace(scene.tuning.model, inertia=inertia, segments=4))
        run = simulate(scene, scene.make_plant(), make_controller(scene, tuning))
        summary = run.summary()
        errors[inertia] = summary["rms_mm"]
        assert summary["fallbacks"] == summary["limit_violations"] == 0
    assert errors["condensed"] < 0.02
    assert errors["condensed"] < 0.3 * errors["none"]


def test_heavy_rods_are_driven_fast():
    """The motors' rates alone lead a robot with such rods along a reference that a fixed point does not settle on."""
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml")
    robot = replace(scene.robot, rods=tuple(replace(rod, line_density=0.3) for rod in scene.robot.rods))
    scene = replace(scene, robot=robot, trajectory=replace(scene.trajectory, period=1.5), duration=1.5)
    scene = replace(scene, plant=replace(scene.plant, inertia="condensed"))
    reference = feed_forward(scene, robot, scene.start(), 5, "condensed")
    plant, x, errors = scene.make_plant(), reference.states[0], []
    plant.reset(x, scene.start())
    for k in range(scene.n_periods):
        for _ in range(round(scene.period / plant.dt)):
            x = plant.step(x, reference.inputs[k])
        errors.append(np.linalg.norm(x[:2] - reference.states[k + 1, :2]))
    assert np.ptp(reference.states[:, 0]) > 0.02
    assert max(errors) < 5e-5


def test_heavy_wires_are_led_at_any_control_period():
    """Where periods are short against the vibration of the rods with the tip at rest, differences would excite it.

    On a motion that takes all of the motors' change of rate, the angles then do not depend on the period; they begin
    at rest, as the robot does.
    """
    scene = load_scene(MODELS / "scenes" / "eight_points.toml")
    wires = tuple(replace(rod, bending_stiffness=0.0101, line_density=0.0062) for rod in scene.robot.rods)
    robot = replace(scene.robot, rods=wires, tip_mass=0.04, drag=0.02)
    scene = replace(scene, robot=robot, tuning=None)
    planned = plan_timing(scene, limits=PlanLimits(6.0, 300.0, 1.5), cells=40)
    angles, changes = {}, {}
    for period in (0.005, 0.002):
        quick = replace(scene, trajectory=planned, period=period, duration=round(planned.duration + 0.1, 2))
        found = feed_forward(quick, robot, scene.start(), 0, "condensed").states[:, 4:]
        angles[period] = found[:: round(0.01 / period)]
        changes[period] = np.abs(np.diff(found, 2, axis=0)).max() / period**2
        assert found[0] == pytest.approx(scene.start().q, abs=1e-9)
    light = feed_forward(quick, robot, scene.start(), 0).states[:: round(0.01 / period), 4:]
    by_mass = np.abs(angles[0.002] - light).max()
    assert by_mass > 0.02
    assert np.abs(angles[0.002] - angles[0.005]).max() < 0.1 * by_mass
    assert max(changes.values()) < 2.0 * 300.0
