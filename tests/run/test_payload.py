"""What the tip picks up and puts down: against a heavier tip, by momentum, in scenes and in the loop."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import ModelError, Plant, inverse_statics, linearise, load_scene, make_controller, simulate
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.loop.scene.settings import Payload
from tests.conftest import MODELS

LOAD = 0.25
RUNGS = [("none", "rk4"), ("constant", "rk4"), ("condensed", "velocity_verlet"), ("full", "gauss")]


def moving(plant, pose, v, u, steps=20):
    """Plant and its state some steps after it was let go with the velocity v."""
    x = np.concatenate([pose.p, v, pose.q])
    plant.reset(x, pose)
    for _ in range(steps):
        x = plant.step(x, u)
    return x


@pytest.mark.parametrize(("inertia", "integrator"), RUNGS)
def test_a_carried_mass_is_as_good_as_a_heavier_tip(pair, centre, inertia, integrator):
    heavier = replace(pair, tip_mass=pair.tip_mass + LOAD)
    carrying, heavy = (Plant(robot, inertia=inertia, integrator=integrator, dt=2e-3) for robot in (pair, heavier))
    x = np.concatenate([centre.p + [0.01, 0.0], [0.0, 0.0], centre.q])
    for plant in (carrying, heavy):
        plant.reset(x, centre)
    a = b = carrying.carry(LOAD, x)
    assert (a == x).all()
    for _ in range(50):
        a, b = carrying.step(a, (1.0, -0.5)), heavy.step(b, (1.0, -0.5))
    assert a == pytest.approx(b, abs=1e-12)
    models = [linearise(plant, a, (0.0, 0.0), 0.01) for plant in (carrying, heavy)]
    assert models[0].A == pytest.approx(models[1].A, abs=1e-10)
    carrying.reset(x, centre)
    assert carrying.payload == 0.0
    assert carrying.mass(x[:2], x[4:])[0][0, 0] < pair.tip_mass + 0.1


def test_a_payload_has_weight(pair):
    vertical = replace(pair, gravity=(0.0, -9.81))
    pose = inverse_statics(vertical, (0.0, 0.25), mode="LR")
    plant = Plant(vertical, integrator="rk4", dt=1e-4)
    x = np.concatenate([pose.p, [0.0, 0.0], pose.q])
    plant.reset(x, pose)
    assert plant.step(x, (0.0, 0.0))[2:4] == pytest.approx([0.0, 0.0], abs=1e-9)
    after = plant.step(plant.carry(LOAD, x), (0.0, 0.0))
    assert after[2:4] == pytest.approx([0.0, -9.81 * LOAD / (0.25 + LOAD) * 1e-4], abs=1e-8)
    heavier = inverse_statics(replace(vertical, tip_mass=0.25 + LOAD), (0.0, 0.25), mode="LR")
    x = np.concatenate([heavier.p, [0.0, 0.0], heavier.q])
    plant.reset(x, heavier)
    assert plant.step(plant.carry(LOAD, x), (0.0, 0.0))[2:4] == pytest.approx([0.0, 0.0], abs=1e-9)


@pytest.mark.parametrize(("inertia", "integrator"), RUNGS)
def test_picking_up_keeps_the_momentum_and_putting_down_the_velocity(pair, centre, inertia, integrator):
    plant = Plant(pair, inertia=inertia, integrator=integrator, dt=1e-3)
    x = moving(plant, centre, (0.3, -0.2), (0.0, 0.0))
    before = plant.mass(x[:2], x[4:])[0][:2, :2] @ x[2:4]
    picked = plant.carry(LOAD, x)
    after = plant.mass(x[:2], x[4:])[0][:2, :2] @ picked[2:4]
    # Distributed rods pass the impulse on with their own inertia, which the condensed one is close to.
    assert after == pytest.approx(before, rel=5e-3 if inertia == "full" else 1e-12)
    if inertia == "none":
        assert picked[2:4] == pytest.approx(x[2:4] / 2, rel=1e-14)
    assert picked[[0, 1, 4, 5]] == pytest.approx(x[[0, 1, 4, 5]], abs=0.0)
    assert (plant.carry(0.0, picked) == picked).all()


def test_a_pick_in_motion_is_the_same_for_condensed_and_distributed_rods(pair, centre):
    """And not for massless ones, which are off by the rods' share of the mass; motors turning."""
    ends = {}
    for inertia, integrator in RUNGS:
        plant = Plant(pair, inertia=inertia, integrator=integrator, dt=1e-3)
        x = plant.carry(LOAD, moving(plant, centre, (0.3, -0.2), (1.0, 0.5), steps=100))
        for k in range(200):
            x = plant.carry(0.0, x) if k == 100 else x
            x = plant.step(x, (-1.0, 0.5))
        ends[inertia] = x[:2]
    assert np.linalg.norm(ends["condensed"] - ends["full"]) < 2e-5
    assert np.linalg.norm(ends["none"] - ends["full"]) > 1e-4


def test_distributed_rods_take_the_impulse_of_a_pick(pair, centre):
    """The energy that the impact loses is right, and the rods' tips stay with the pin."""
    plant = Plant(pair, inertia="full", integrator="gauss", dt=1e-3)
    x = moving(plant, centre, (0.3, -0.2), (0.0, 0.0))
    rods = plant._modal.rods
    state = plant._modal._last[1]
    light = rods.energy(state)
    rods.tip_mass = pair.tip_mass + LOAD
    picked = rods.picked_up(state, LOAD)
    # A plastic impact loses the energy of the relative velocity: m v dv / 2 of the tip, whatever hangs on it.
    lost = pair.tip_mass * state.v @ state.v / 2 + (light - pair.tip_mass * state.v @ state.v / 2)
    lost -= rods.energy(picked)
    assert lost == pytest.approx(LOAD * state.v @ picked.v / 2, rel=1e-9)
    tips = rods.modes.tip_velocities(picked.a, picked.a_dot, picked.q, picked.u) * pair.lengths[:, None]
    assert tips == pytest.approx(np.tile(picked.v, (2, 1)), abs=1e-9)
    assert x.shape == (6,)


@pytest.fixture(scope="module")
def scene():
    """With the paper's rods at steps of a millisecond."""
    scene = load_scene(MODELS / "scenes/payload.toml")
    return replace(scene, plant=replace(scene.plant, inertia="none", integrator="rk4", dt=1e-3))


def test_the_scene_doubles_the_mass_at_rest(scene):
    robot, payload = scene.robot, scene.payload
    assert payload.mass == robot.tip_mass
    times = np.array([0.0, payload.pick - 1e-3, payload.pick, payload.place - 1e-3, payload.place, 9.0])
    assert scene.carried(times).tolist() == [0.0, 0.0, LOAD, LOAD, 0.0, 0.0]
    # Sums of steps, whatever they are measured in: 3 * 0.1 is more than 0.3, and 7 * 0.1 is too.
    for unit in (1e-10, 1.0, 1e5):
        carried = Payload(LOAD, unit * 0.3, unit * 0.7).carried(unit * 0.1 * np.arange(10))
        assert carried.tolist() == [0.0] * 3 + [LOAD] * 4 + [0.0] * 3
    assert scene.trajectory(np.array([payload.pick, payload.place]))[:, 1] == pytest.approx(np.zeros((2, 2)))


def test_the_loop_picks_up_at_the_right_step(scene):
    """In motion, so that it shows: the velocity halves at the step of the pick and nowhere else."""
    scene = replace(scene, payload=Payload(LOAD, 0.304, 9.0), duration=0.4)
    run = simulate(scene, scene.make_plant(), make_controller(scene))
    speed = np.hypot(*run.x[:, 2:4].T)
    ratio = speed[301:310] / speed[300:309]
    assert ratio.argmin() == 4  # from t = 0.304 s to the next step
    assert ratio.min() == pytest.approx(0.5, abs=0.05)
    assert (np.delete(ratio, 4) > 0.9).all()


def test_knowing_the_payload(scene):
    errors = {}
    for known in (True, False):
        tuning = replace(scene.tuning, model=replace(scene.tuning.model, payload=known))
        errors[known] = simulate(scene, scene.make_plant(), make_controller(scene, tuning)).summary()["max_mm"]
    assert errors[True] < 0.1
    assert errors[False] > 5.0


def test_a_known_payload_with_weight_does_not_make_the_tip_sink(scene):
    """10 g picked up at rest in a vertical plane: the motors lift as it is taken, by a feed-forward that knows when."""
    robot = replace(scene.robot, gravity=(0.0, -9.81))
    scene = replace(scene, robot=robot, payload=Payload(0.01, 0.3, 0.6), duration=0.8,
                    trajectory=replace(scene.trajectory, wait=2.0))  # fmt: skip
    scene = replace(scene, plant=replace(scene.plant, weight="condensed"))
    tuning = replace(load_scene(MODELS / "scenes/vertical.toml").tuning, observer=None)
    sinks = {}
    for known in (True, False):
        mine = replace(tuning, model=replace(tuning.model, payload=known))
        run = simulate(scene, scene.make_plant(), make_controller(scene, mine))
        sinks[known] = run.error[450:600].max()
    assert sinks[True] < 0.2 * sinks[False]


def test_the_feed_forward_carries_mass_and_weight_while_they_are_there(scene):
    """Rods in equilibrium with m (g - a) - c v, by the plant's own force."""
    robot = replace(scene.robot, gravity=(0.0, -9.81))
    scene = replace(scene, robot=robot, payload=Payload(0.05, 0.3, 0.6))
    pose = scene.start()
    reference = feed_forward(scene, robot, pose, 0)
    plant = Plant(robot, weight="exact")
    plant.reset(reference.states[0], pose)
    for k in range(0, 80, 10):
        x = reference.states[k]
        _, v, a = scene.trajectory(np.array([k * scene.period]))[0]
        mass = robot.tip_mass + (0.05 if 30 <= k < 60 else 0.0)
        wanted = mass * (np.array(robot.gravity) - a) - robot.drag * v
        assert plant.force(x[:2], x[4:]) == pytest.approx(wanted, abs=1e-6), k


@pytest.mark.parametrize(("linearise", "bound"), [("along_plan", 0.1), ("here", 3.0)])
def test_the_payload_of_a_period_to_come_is_that_of_its_time(scene, linearise, bound):
    """With delay; the errors are 0.05 and 2.2 mm, without a payload half of that."""
    tuning = replace(scene.tuning, model=replace(scene.tuning.model, linearise=linearise))
    late = replace(scene, delay=2, tuning=tuning)
    assert simulate(late, late.make_plant(), make_controller(late)).summary()["max_mm"] < bound


def test_wrong_payloads_are_refused(scene, tmp_path, pair):
    text = (MODELS / "scenes/payload.toml").read_text().replace("../..", str(MODELS.parent))
    text = text.replace('"../planar_pair', f'"{MODELS}/planar_pair')
    for old, new, key in (("place = 1.0", "place = 0.1", "place"), ("mass = 0.25", "mass = 0.0", "mass")):
        (tmp_path / "scene.toml").write_text(text.replace(old, new))
        with pytest.raises(ModelError, match=f"payload.{key}"):
            load_scene(tmp_path / "scene.toml")
    with pytest.raises(ValueError, match="payload"):
        Plant(pair).carry(-0.1, np.zeros(6))
    nonlinear = replace(scene.tuning, law="nonlinear_mpc")
    with pytest.raises(ValueError, match="knows no payload"):
        make_controller(scene, nonlinear).start(scene.start())


def test_mujoco_carries_it_too(pair, centre):
    pytest.importorskip("mujoco")
    from pcr_mpc.plant.mujoco.plant import MuJoCoPlant

    ends = []
    for plant in (MuJoCoPlant(pair, links=40), Plant(pair, inertia="full", integrator="gauss", dt=1e-3)):
        x = moving(plant, centre, (0.3, -0.2), (0.0, 0.0), steps=50)
        speed = x[2:4].copy()
        x = plant.carry(LOAD, x)
        assert x[2:4] == pytest.approx(speed * 0.25 / (0.25 + LOAD), rel=0.03)
        for _ in range(100):
            x = plant.step(x, (0.0, 0.0))
        ends.append(x[:2])
    assert np.linalg.norm(ends[0] - ends[1]) < 2e-4
    assert np.linalg.norm(ends[0] - centre.p) > 5e-3
