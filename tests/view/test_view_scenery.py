"""What stands behind the robot: the cached workspace, and ghosts that are followed."""

import os
import signal
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import inverse_statics, load_scene, shipped
from pcr_mpc.plant.statics.stability import held_equilibria
from pcr_mpc.view import scenery
from pcr_mpc.view.scenery import Scenery, find_ghosts, find_workspace

pytestmark = pytest.mark.slow


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setattr(scenery, "cache_folder", lambda: tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def scene():
    return load_scene(shipped("lemniscate"))


def test_the_workspace_is_held_without_load_up_to_its_edge_and_found_once(scene, cache, monkeypatch):
    monkeypatch.setattr(scenery, "_SPACING", 0.25)
    pose = scene.start()
    found = find_workspace(pose)
    assert len(found["cells"]) > 20
    rods = (
        replace(rod, angle_limits=(rod.angle_limits[0] - 0.1, rod.angle_limits[1] + 0.1)) for rod in scene.robot.rods
    )
    wider = replace(scene.robot, rods=tuple(rods))
    within = [cell for cell in found["cells"] if cell[2]]
    assert 5 < len(within) < len(found["cells"])
    for points, softest, _ in within[::4]:
        # What inverse statics find there, which mind the stops; the cut between lattice points is by straight lines.
        middle = np.mean(points, axis=0)
        eq = inverse_statics(wider, middle, guess=pose)
        assert eq.force == pytest.approx([0, 0], abs=1e-6)
        assert eq.stable
        assert softest > 0
    reasons = {reason for _, reason in found["edge"]}
    assert reasons <= {"stops", "type 1", "type 2", "rod limit", "reach", "overlap", "lost"}
    assert len(list(cache.iterdir())) == 1
    monkeypatch.setattr(scenery, "explore", None)  # it is not looked for again
    assert find_workspace(pose) == found
    next(cache.iterdir()).write_text("{broken")
    with pytest.raises(TypeError):
        find_workspace(pose)


def test_polygons_are_cut_where_their_number_is_zero():
    square = [(np.array(p, dtype=float), float(p[0]) - 0.25) for p in ((0, 0), (1, 0), (1, 1), (0, 1))]
    part = scenery._cut(square)
    assert [p.tolist() for p, _ in part] == [[0, 0], [0.25, 0], [0.25, 1], [0, 1]]
    other = scenery._cut([(p, -excess) for p, excess in square])
    assert [p.tolist() for p, _ in other] == [[0.25, 0], [1, 0], [1, 1], [0.25, 1]]
    assert scenery._cut([(p, 1.0) for p, _ in square]) == []


def test_robots_without_such_a_workspace_say_so():
    for name in ("three_rods", "curved_rods"):
        assert "two plain rods" in find_workspace(load_scene(shipped(name)).start())["problem"]


def test_ghosts_are_equilibria_and_followed_as_the_motors_turn(scene):
    start = scene.start()
    first = find_ghosts(scene.robot, start.q, anew=True)
    assert first["all"]
    modes = {ghost["mode"] for ghost in first["ghosts"] if ghost["stable"]}
    assert modes == {"LR", "RL", "LL", "RR"}
    mine = next(ghost for ghost in first["ghosts"] if ghost["mode"] == "LR" and ghost["stable"])
    assert mine["p"] == pytest.approx(start.p, abs=1e-5)
    q = start.q + [0.1, -0.05]
    later = find_ghosts(scene.robot, q)
    assert not later["all"]
    assert {ghost["mode"] for ghost in later["ghosts"]} == modes
    for ghost in later["ghosts"]:
        # The statics' own list at that tip has a shape of the rods that is in balance.
        held = held_equilibria(scene.robot, np.array(ghost["p"]), q)
        assert min(np.hypot(*eq.force) for eq in held if eq.mode == ghost["mode"]) < 1e-3


def test_the_other_process_ends_when_it_is_told(scene, cache):
    asked, found = Scenery(), []
    robot = load_scene(shipped("three_rods"))
    asking = threading.Thread(target=lambda: found.append(asked.workspace(robot.start())))
    asking.start()
    while asked._process is None or asked._process.pid is None:
        time.sleep(1e-3)
    process = asked._process
    while asking.is_alive():  # Ctrl-C in a terminal reaches it too, while it loads and later
        os.kill(process.pid, signal.SIGINT)
        asking.join(0.02)
    assert "two plain rods" in found[0]["problem"]
    assert process.is_alive()
    asked.end()
    assert not process.is_alive()
    assert asked.workspace(robot.start()) is None
