"""A rod whose shape is gone: where it lands, what it loses, who is told."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pcr_mpc import Plant, all_equilibria, load_scene, make_controller, simulate, solve_statics
from pcr_mpc.plant.rods.closed_form import elastica
from pcr_mpc.plant.rods.snap import landing
from pcr_mpc.plant.statics.stability import count_conjugate_points
from tests.conftest import MODELS

WINDING = 5.0  # turn of the first motor on which its rod snaps [rad]


def wind_up(plant, pose, steps, turn=WINDING):
    plant.reset(np.concatenate([pose.p, [0, 0], pose.q]), pose)
    for angle in np.linspace(0.0, turn, steps + 1)[1:]:
        plant.force(pose.p, pose.q + [angle, 0.0])
    return plant.equilibrium(np.concatenate([pose.p, [0, 0], pose.q + [turn, 0.0]]))


@pytest.mark.parametrize("method", ["closed_form", "multiple_shooting"])
def test_a_snap_lands_on_a_listed_equilibrium(pair, centre, method):
    plant = Plant(pair, method=method, on_snap="jump", steps=4)
    after = wind_up(plant, centre, 60)
    (snap,) = plant.snaps
    assert snap.rod == 0
    assert snap.p == pytest.approx(tuple(centre.p))
    assert count_conjugate_points(after) == 0  # by a sweep along the rods, not by the solver's own verdict
    listed = all_equilibria(pair, centre.p, after.q)
    assert min(np.abs(eq.rod_forces - after.rod_forces).max() for eq in listed) < 1e-6
    # What was lost, by the energies on either side.
    fold = centre.q + [snap.q - centre.q[0], 0.0]
    before = solve_statics(pair, centre.p, fold - [1e-3, 0.0], guess=centre)
    others = all_equilibria(pair, centre.p, fold)
    assert any(before.energy - eq.energy == pytest.approx(snap.energy_lost, rel=2e-2) for eq in others)
    assert snap.energy_lost > 0


def test_where_it_lands_does_not_depend_on_the_steps(pair, centre):
    ends, places = [], []
    for steps in (1, 9, 200):
        plant = Plant(pair, on_snap="jump")
        ends.append(wind_up(plant, centre, steps).rod_forces)
        places.append([(snap.rod, snap.q) for snap in plant.snaps])
    assert ends[1] == pytest.approx(ends[0], abs=1e-8)
    assert ends[2] == pytest.approx(ends[0], abs=1e-8)
    assert places[2] == [(0, pytest.approx(places[0][0][1], abs=0.02))]


def test_descent_against_another_one(pair, centre):
    """The same flow with springs instead of the constraint, by an implicit solver for ODEs, ends in the same shape."""
    plant = Plant(pair, on_snap="jump")
    after = wind_up(plant, centre, 400)
    (snap,) = plant.snaps
    last = solve_statics(pair, centre.p, [snap.q - 0.01, centre.q[1]], guess=centre)
    rod = pair.rods[0]
    pose = np.array([*(centre.p - rod.base) / rod.length, snap.q + 0.1])
    links = 30
    ds, stiff = 1.0 / links, 1e4
    middles = (np.arange(links) + 0.5) * ds

    def downhill(_, theta):
        gap = ds * np.array([np.cos(theta).sum(), np.sin(theta).sum()]) - pose[:2]
        moment = np.append(2.0, np.ones(links - 1)) * np.diff(theta, prepend=pose[2]) / ds
        slope = moment - np.append(moment[1:], 0.0)
        return -slope / ds - stiff * (gap[1] * np.cos(theta) - gap[0] * np.sin(theta))

    start = np.interp(middles, np.arange(8) / 8, last.nodes[0, 0])

    def at_rest(_, theta):
        return np.abs(downhill(_, theta)).max() - 1e-3

    at_rest.terminal = True
    flow = solve_ivp(downhill, (0.0, 1e3), start, "Radau", events=at_rest, rtol=1e-5, atol=1e-7)
    landed = landing(last.nodes[0], pose)
    assert np.interp(np.arange(1, 8) / 8, middles, flow.y[:, -1]) == pytest.approx(landed[0, 1:], abs=0.05)
    there = solve_statics(pair, centre.p, [pose[2], centre.q[1]], guess=after)
    assert elastica.from_nodes(landed) == pytest.approx(elastica.from_nodes(there.nodes[0]), abs=0.02)


def test_a_run_records_its_snaps(pair):
    """One motor winds its rod up far beyond the stops that the real one has."""
    scene = load_scene(MODELS / "scenes" / "release.toml")
    rods = tuple(replace(rod, angle_limits=(rod.angle_limits[0], 20.0)) for rod in pair.rods)
    scene = replace(
        scene, robot=replace(pair, rods=rods), duration=2.0, plant=replace(scene.plant, on_snap="jump", dt=5e-4)
    )
    controller = make_controller(scene)

    class Winding:
        name = "winding"
        start = controller.start

        def step(self, k, x):
            return replace(controller.step(k, x), u=np.array([4.0, 0.0]))

    run = simulate(scene, scene.make_plant(), Winding())
    snaps = [event for event in run.events if event["kind"] == "snap"]
    assert snaps
    assert run.summary()["snaps"] == len(snaps)
    assert "lost" in snaps[0]["message"]
    assert run.summary()["statics_rungs"]["snap"] == len(snaps)


def test_rungs_are_counted(pair, centre):
    plant = Plant(pair)
    x = np.concatenate([centre.p, [0, 0], centre.q])
    plant.reset(x)
    assert plant.rungs == {"cold": 1, "warm": 1}
    plant.force(centre.p + [1e-4, 0.0], centre.q)
    assert plant.rungs["warm"] == 2
    plant.force(centre.p + [0.1, -0.1], centre.q + [0.5, 0.5])
    assert plant.rungs.get("newton", 0) + plant.rungs.get("continuation", 0) == 1
    assert solve_statics(pair, centre.p, centre.q).rung == "cold"
    assert solve_statics(pair, centre.p, centre.q, guess=centre).rung == "warm"


def test_single_shooting_does_not_notice_snaps(pair):
    with pytest.raises(ValueError, match="on_snap"):
        Plant(pair, method="single_shooting", on_snap="jump")
    with pytest.raises(ValueError, match="on_snap"):
        Plant(pair, on_snap="fly")


def test_a_snap_that_is_undone_is_not_kept(pair, centre):
    plant = Plant(pair, on_snap="jump")
    wind_up(plant, centre, 20, turn=0.3 * WINDING)
    assert plant.snaps == []
    solver = plant._rods.solver
    solver.move(centre.p, centre.q + [WINDING, 0.0])
    assert len(solver.snaps) == 1
    solver.go_back()
    assert solver.snaps == []
