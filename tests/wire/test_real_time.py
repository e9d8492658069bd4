"""A plant by the clock: late as in a simulation, and the same motion without a wire."""

import math
import socket
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pcr_mpc.errors import PCRError
from pcr_mpc.loop.hardware.motors import Motors
from pcr_mpc.loop.run.simulate import simulate
from pcr_mpc.loop.scene.file import load_scene
from pcr_mpc.wire import hil, real_time
from pcr_mpc.wire.decider import make_decider
from pcr_mpc.wire.happened import Arrival, Happened, replayed
from pcr_mpc.wire.hardware import Hardware
from pcr_mpc.wire.hil import run_hil
from pcr_mpc.wire.packet import Command, pack_command, pack_measurement, unpack_command, unpack_measurement
from pcr_mpc.wire.real_time import run_plant
from pcr_mpc.wire.server import Server
from tests.conftest import ROOT
from tests.wire.packets import ME


def test_the_clock_waits_for_the_first_command():
    """The reference begins with the first measurement that the server sees: one that comes late must not shift it."""
    scene = replace(load_scene(ROOT / "models" / "scenes" / "hold_slow.toml"), duration=0.05)
    heard = []

    def answer(server):
        time.sleep(0.2)  # many periods
        for _ in range(scene.n_periods):
            data, sender = server.recvfrom(1000)
            found = unpack_measurement(data, 2)
            heard.append((found.sequence, found.time))
            server.sendto(pack_command(Command(found.sequence, found.time, np.zeros(2), 0)), sender)

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        server.settimeout(10.0)
        thread = threading.Thread(target=answer, args=(server,))
        thread.start()
        log = run_plant(scene, server.getsockname(), progress=False)
        thread.join()
    assert heard[:2] == [(0, 0.0), (1, pytest.approx(scene.period))]
    assert (len(log.states), len(log.late), len(log.round_trip)) == (26, 25, 5)
    assert np.isfinite(log.round_trip).any()
    assert log.happened.arrivals[0] == (0.0, 0, False)


def test_a_controller_may_take_long_to_get_ready():
    """C of a minute at 1 kHz takes minutes; a process that has ended does not."""

    class Pipe:
        asked = 0

        def poll(self, wait):
            self.asked += 1
            return self.asked > 5000

        def recv(self):
            return "ready"

    assert hil._expected(Pipe(), SimpleNamespace(is_alive=lambda: True), math.inf) == "ready"
    with pytest.raises(PCRError, match="has ended"):
        hil._expected(Pipe(), SimpleNamespace(is_alive=lambda: False), math.inf)


def test_a_server_that_is_silent_is_told(monkeypatch):
    monkeypatch.setattr(real_time, "_GREETING", 0.05)
    scene = replace(load_scene(ROOT / "models" / "scenes" / "hold_slow.toml"), duration=0.05)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.bind(("127.0.0.1", 0))
        with pytest.raises(PCRError, match=r"not answered for 0.05 s; try `pcr-mpc serve`"):
            run_plant(scene, deaf.getsockname(), progress=False)


@pytest.mark.parametrize("inside", [0.0, 3.7])
def test_hardware_in_real_time_is_late_as_in_a_simulation(inside):
    """The same commands, one a period, lead to the same states, and the same is measured; they may come within a step.

    What is late by a scene's own figure in the one run comes late in the other.
    """
    scene = replace(
        load_scene(ROOT / "models" / "scenes" / "servo.toml"),
        duration=0.12,
        motors=Motors(time_constant=0.02, backlash=0.01),
        wrapped=True,
        untold_delay=0.0037,
        delay=2,
    )
    told = 0.5 * np.sin(np.arange(scene.n_periods)[:, None] + np.arange(2))

    class Given:
        def start(self, pose):
            pass

        def step(self, k, x):
            return told[k]

    run = simulate(scene, scene.make_plant(), Given(), 0)
    robot = Hardware(replace(scene, untold_delay=0.0) if inside else scene)
    for k, u in enumerate(told):
        found = robot.measured(k)
        wanted = run.measured[k][[0, 1, 4, 5]]
        np.testing.assert_allclose([*found.p, *found.q], wanted, rtol=0.0, atol=1e-12 * (inside > 0.0))
        robot.told(u, 10 * k + (20 + inside if inside else 0), 10 * k)
        for _ in range(10):
            robot.step()
    np.testing.assert_allclose(robot.states, run.x, rtol=0.0, atol=1e-11 * (inside > 0.0))
    assert np.abs(run.x[-1, 4:] - run.x[0, 4:]).max() > 1e-3  # it has moved


def test_commands_that_come_within_one_step_turn_the_motors_by_what_they_must():
    robot = Hardware(replace(load_scene(ROOT / "models" / "scenes" / "hold_slow.toml"), duration=0.04))
    before = robot.states[0, 4:].copy()
    for at, u in ((0.25, 1.0), (0.5, -2.0), (1.0, 0.5)):
        robot.told(np.full(2, u), at, at)
    robot.step()
    robot.step()
    turned = robot.dt * np.array([0.25 * 1.0 + 0.5 * -2.0, 0.5])
    np.testing.assert_allclose(np.diff([before[0], *robot.states[1:3, 4]]), turned, rtol=0.0, atol=1e-15)


def test_what_happened_is_what_the_loop_without_a_wire_does():
    """Late, lost, doubled and resting commands; one that came a tenth of a step later moves the robot elsewhere."""
    scene = replace(load_scene(ROOT / "models" / "scenes" / "lemniscate.toml"), duration=0.12)
    decider = make_decider(scene, generated=False)
    server, robot, happened = Server(decider, ("127.0.0.1", 0)), Hardware(scene), Happened()
    per = robot.steps // scene.n_periods
    waiting = {}

    def answered(data, at):
        if data is not None:  # nobody is served once the motors rest
            waiting.setdefault(int(at), []).append((unpack_command(data, 2), at))

    for step in range(robot.steps):
        if step % per == 0 and (k := step // per) not in (5, 6):
            found = robot.measured(k)
            answered(server.take(pack_measurement(found), ME), step + (0.0, 0.4, 7.3)[k % 3])
        elif step % per == 0:
            robot.measured(step // per)
            answered(server.wait(), step + 0.5)
        for command, at in waiting.pop(step, ()):
            arrival = Arrival.of(command, at)
            happened.arrivals.append(arrival)
            robot.told(command.u, at, arrival.since(per))
        robot.step()
    server.close()
    assert {each.rests for each in happened.arrivals} == {True, False}
    np.testing.assert_array_equal(replayed(scene, decider, happened), robot.states)
    first = happened.arrivals[1]
    happened.arrivals[1] = first._replace(at=first.at + 0.1)
    assert np.abs(replayed(scene, decider, happened) - robot.states).max() > 1e-9


@pytest.mark.slow
def test_a_loop_in_real_time_says_what_it_was():
    scene = load_scene(ROOT / "models" / "scenes" / "hold_slow.toml")
    found = run_hil(scene.tuned(scene.tuning)).summary()
    assert found["periods"] == scene.n_periods - 1
    # The greeting is answered too.
    assert found["server"]["answered"] + found["server"].get("skipped", 0) <= found["periods"] + 1
    assert found["missed"] < found["periods"]
    # What the wire adds is latency, and nothing else.
    assert found["replayed_apart_mm"] == 0.0
    assert found["replayed_rms_mm"] == found["rms_mm"]
    assert found["max_mm"] < 20.0  # it holds, and shifts; how well depends on the machine
