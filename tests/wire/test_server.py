"""The server that answers packets: what is none moves no motor, and silence brings them to rest."""

import shutil
import socket
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcr_mpc.cli import main
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.errors import OutputError, PCRError
from pcr_mpc.loop.parts.assembled import resting_state
from pcr_mpc.loop.scene.file import load_scene
from pcr_mpc.wire.decider import make_decider
from pcr_mpc.wire.packet import RESTING, Command, unpack_command
from pcr_mpc.wire.server import Server
from tests.conftest import ROOT
from tests.wire.packets import ME, OTHER, measurement


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


@pytest.fixture
def server():
    made = Server(Echo(), ("127.0.0.1", 0))
    yield made
    made.close()


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


def test_old_repeated_and_foreign_packets_are_counted_and_ignored(server):
    assert unpack_command(server.take(measurement(5), ME), 2).u.tolist() == [3.0, 0.0]
    for sequence, sender in ((5, ME), (4, ME), (6, OTHER), (5 + 2**31, ME)):
        assert server.take(measurement(sequence, (1.0, 1.0)), sender) is None
    assert server._decider.u.tolist() == [3.0, 0.0]
    assert server.counts == {"answered": 1, "old": 3, "foreign": 1}
    assert server.take(measurement(6, (1.0, 1.0)), ME) is not None


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
