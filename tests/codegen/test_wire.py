"""Packets, and the server that answers them: what is none moves no motor, and silence brings them to rest."""

import math
import shutil
import socket
import struct
import threading
import time
import zlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcr_mpc.cli import main
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.errors import OutputError, PCRError
from pcr_mpc.loop.hardware.motors import Motors
from pcr_mpc.loop.parts.assembled import resting_state
from pcr_mpc.loop.run.simulate import simulate
from pcr_mpc.loop.scene.file import load_scene
from pcr_mpc.wire import hil, real_time
from pcr_mpc.wire.decider import make_decider
from pcr_mpc.wire.happened import Arrival, Happened, replayed
from pcr_mpc.wire.hardware import Hardware
from pcr_mpc.wire.hil import run_hil
from pcr_mpc.wire.packet import (
    RESTING,
    Command,
    Measurement,
    command_size,
    measurement_size,
    newer,
    pack_command,
    pack_measurement,
    unpack_command,
    unpack_measurement,
)
from pcr_mpc.wire.real_time import run_plant
from pcr_mpc.wire.server import Server
from tests.conftest import ROOT

ME, OTHER = ("127.0.0.1", 40001), ("127.0.0.1", 40002)


class Echo:
    """A decider that turns the motors as the tip says."""

    def __init__(self):
        self.n, self.period, self.u, self.stopped = 2, 0.01, np.zeros(2), 0
        self.limits = Limits(6.0, 2.5, np.full(2, -9.0), np.full(2, 9.0))

    def answer(self, found):
        if not np.isfinite(found.p).all():
            raise PCRError("nowhere")
        self.u = found.p
        return Command(found.sequence, found.time, self.u, 0)

    def rest(self, sequence, time):
        self.u = self.limits.slowed(self.u)
        return Command(sequence, time, self.u, RESTING)

    def stop(self):
        self.stopped += 1


def measurement(sequence, p=(3.0, 0.0), q=(1.0, 2.0), time=0.0):
    return pack_measurement(Measurement(sequence, time, np.array(p), np.array(q)))


@pytest.fixture
def server():
    made = Server(Echo(), ("127.0.0.1", 0))
    yield made
    made.close()


doubles = st.floats(allow_nan=True, allow_infinity=True)


@given(st.integers(0, 2**32 - 1), doubles, st.lists(doubles, min_size=2, max_size=2), st.lists(doubles, max_size=4))
def test_a_measurement_arrives_as_it_was_sent(sequence, time, p, q):
    data = pack_measurement(Measurement(sequence, time, np.array(p), np.array(q)))
    assert len(data) == measurement_size(len(q))
    found = unpack_measurement(data, len(q))
    assert found.sequence == sequence
    assert np.array_equal([found.time, *found.p, *found.q], [time, *p, *q], equal_nan=True)
    assert unpack_measurement(data, len(q) + 1) is None
    assert unpack_command(data, len(q)) is None


def test_the_bytes_are_those_of_the_page():
    # Written out here: little-endian, no gaps, the checksum last.
    body = struct.pack("<4sHBBId4d", b"PCR\x01", 1, 1, 2, 7, 0.07, 0.01, 0.25, 3.4, -0.2)
    expected = body + struct.pack("<I", zlib.crc32(body))
    assert measurement(7, (0.01, 0.25), (3.4, -0.2), 0.07) == expected
    assert len(expected) == 56
    body = struct.pack("<4sHBBIdBBH5d", b"PCR\x01", 1, 2, 2, 7, 0.07, 1, 2, 30, 0.5, -0.5, 80.0, 0.1, 0.2)
    command = Command(7, 0.07, np.array([0.5, -0.5]), 1, 2, 30, 80.0, np.array([0.1, 0.2]))
    assert pack_command(command) == body + struct.pack("<I", zlib.crc32(body))
    assert command_size(2) == 68


@given(st.binary(max_size=200), st.sampled_from([ME, OTHER]))
def test_bytes_that_are_no_measurement_move_no_motor(data, sender):
    server = Server(Echo(), ("127.0.0.1", 0))
    try:
        assert server.take(data, sender) is None
        assert not server._decider.u.any()
        assert server.counts == {"wrong": 1}
        assert server.wait() is None  # nobody is served
    finally:
        server.close()


@given(st.integers(0, 55), st.integers(1, 255))
def test_one_changed_byte_is_found(place, change):
    data = bytearray(measurement(1))
    data[place] ^= change
    assert unpack_measurement(bytes(data), 2) is None


def test_old_repeated_and_foreign_packets_are_counted_and_ignored(server):
    assert unpack_command(server.take(measurement(5), ME), 2).u.tolist() == [3.0, 0.0]
    for sequence, sender in ((5, ME), (4, ME), (6, OTHER), (5 + 2**31, ME)):
        assert server.take(measurement(sequence, (1.0, 1.0)), sender) is None
    assert server._decider.u.tolist() == [3.0, 0.0]
    assert server.counts == {"answered": 1, "old": 3, "foreign": 1}
    assert server.take(measurement(6, (1.0, 1.0)), ME) is not None


def test_the_sequence_runs_round():
    assert newer(0, 2**32 - 1)
    assert not newer(2**32 - 1, 0)
    assert not newer(3, 3)


def test_silence_brings_the_motors_to_rest_within_their_limits(server):
    server.take(measurement(1, (6.0, -3.0)), ME)
    rates = [unpack_command(server.wait(), 2).u.tolist() for _ in range(3)]
    assert rates == [[3.5, -0.5], [1.0, 0.0], [0.0, 0.0]]
    assert server.counts["rests"] == 1
    assert server.wait() is None
    assert server._decider.stopped == 1
    # Then whoever comes next is served, with a sequence of his own.
    assert unpack_command(server.take(measurement(0), OTHER), 2).u.tolist() == [3.0, 0.0]


def test_measurements_do_not_interrupt_coming_to_rest(server):
    server.take(measurement(1, (6.0, 0.0)), ME)
    server.wait()
    found = unpack_command(server.take(measurement(2, (6.0, 0.0)), ME), 2)
    assert (found.rung, found.u.tolist()) == (RESTING, [1.0, 0.0])


def test_where_there_is_no_answer_the_motors_brake(server):
    server.take(measurement(1, (6.0, 0.0)), ME)
    found = unpack_command(server.take(measurement(2, (np.nan, 0.0)), ME), 2)
    assert (found.rung, found.u.tolist()) == (RESTING, [3.5, 0.0])
    assert server.counts["failures"] == 1
    assert server.problem == "nowhere"


def test_only_loopback_is_listened_on_unless_told_otherwise():
    with pytest.raises(OutputError, match="--anywhere"):
        Server(Echo(), ("0.0.0.0", 0))
    Server(Echo(), ("0.0.0.0", 0), anywhere=True).close()


def test_an_address_is_refused_before_anything_is_made(monkeypatch, capsys):
    monkeypatch.setattr("pcr_mpc.wire.decider.make_decider", lambda *_, **__: pytest.fail("a controller was made"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        for address, said in (("8.8.8.8:1", "--anywhere"), (f"127.0.0.1:{taken.getsockname()[1]}", "cannot listen on")):
            assert main(["serve", "lemniscate", "--generated", "--listen", address]) == 1
            assert said in capsys.readouterr().err


def test_the_loop_over_a_socket(server):
    said, ended = [], threading.Event()
    thread = threading.Thread(target=server.serve, args=(said.append,), kwargs={"until": ended.is_set})
    thread.start()
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
            wire.settimeout(10.0)
            wire.connect(server.address)
            for sequence in range(3):
                wire.send(b"nonsense")
                wire.send(measurement(sequence, (5.0, 1.0)))
                found = unpack_command(wire.recv(100), 2)
                assert (found.sequence, found.rung, found.u.tolist()) == (sequence, 0, [5.0, 1.0])
            rates = [unpack_command(wire.recv(100), 2).u.tolist() for _ in range(2)]
    finally:
        ended.set()
        thread.join()
    assert rates == [[2.5, 0.0], [0.0, 0.0]]
    assert said == ["nothing measured for 5 periods: the motors are brought to rest"]
    assert server.counts["wrong"] == 3


@pytest.mark.slow
@pytest.mark.parametrize("generated", [False, True])
def test_a_scene_is_tracked_through_packets(generated):
    if generated and not (shutil.which("make") and shutil.which("cc")):
        pytest.skip("generated C is compiled here: needs cc and make")
    scene = load_scene(ROOT / "models" / "scenes" / "lemniscate.toml")
    decider = make_decider(scene, generated=generated)
    pose, plant = scene.start(), scene.make_plant()
    server, x = Server(decider, ("127.0.0.1", 0)), resting_state(pose)
    plant.reset(x, pose)
    wanted = scene.trajectory(0.01 * np.arange(101))[:, 0]
    for k in range(100):
        found = unpack_command(server.take(measurement(k, x[:2], x[4:], 0.01 * k), ME), 2)
        assert found.rung == 0
        assert found.stiffness > 0.0
        for _ in range(10):
            x = plant.step(x, found.u)
        assert np.hypot(*(x[:2] - wanted[k + 1])) < 1e-4
    server.close()
    assert server.counts == {"answered": 100}


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


def test_all_that_wait_are_answered_in_their_order_by_a_controller_that_keeps_up(server):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.connect(server.address)
        for first, spent, expected in ((0, 0.0049, [0, 1, 2]), (3, 0.0051, [5])):
            server._spent.extend([spent] * 3)
            for sequence in range(first, first + 3):
                wire.send(measurement(sequence))
            time.sleep(0.01)
            assert [each.sequence for each in server._waiting(1.0)] == expected
    assert server.counts == {"skipped": 2}


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
