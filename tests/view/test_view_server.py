"""The view over its socket, without a browser: who gets in, what harms nothing, who steers, what is dropped."""

import http.client
import json
import socket as sockets
import subprocess
import sys
import threading
import time
from contextlib import closing, suppress
from pathlib import Path

import numpy as np
import pytest

from pcr_mpc import load_scene
from pcr_mpc.errors import OutputError, PCRError
from pcr_mpc.view.commands import LONGEST, MessageError, read
from pcr_mpc.view.live.session import Session
from pcr_mpc.view.pages import Page
from pcr_mpc.view.server import ViewServer

client = pytest.importorskip("websockets.sync.client")
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402

PATIENCE = 20.0  # s


class Served:
    """A server in a thread."""

    def __init__(self, folder):
        scene = load_scene(Path("models/scenes/lemniscate.toml"))
        self.server = ViewServer(lambda: Session(scene), ("127.0.0.1", 0), folder)
        self._ready, self._over = threading.Event(), threading.Event()
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()
        assert self._ready.wait(60)

    def _run(self):
        self.server.serve(lambda _: self._ready.set(), until=self._over.is_set)

    def end(self):
        self._over.set()
        self.thread.join(PATIENCE)
        assert not self.thread.is_alive()

    def socket(self, token=None, **more):
        host, port = self.server.address
        token = self.server.token if token is None else token
        return client.connect(f"ws://{host}:{port}/socket?token={token}", **more)

    def get(self, path, **headers):
        return get(*self.server.address, path, **headers)


def get(host, port, path, **headers):
    """Status, headers and text of an answer."""
    with closing(http.client.HTTPConnection(host, port, timeout=5)) as connection:
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read().decode()


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    # What the workspace rests on is found elsewhere, and slowly.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pcr_mpc.view.scenery.Scenery.workspace", lambda *_: None)
        running = Served(tmp_path_factory.mktemp("recordings"))
        yield running
        running.end()


def ask(socket, **message):
    socket.send(json.dumps(message))


def until(socket, holds, kind="frame"):
    """The first message of a kind for which something holds; frames are told as seen."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        message = json.loads(socket.recv(timeout=PATIENCE))
        if message["kind"] == "frame":
            ask(socket, do="seen", n=message["n"])
        if message["kind"] == kind and holds(message):
            return message
    raise AssertionError(f"no {kind} for which it holds")


def always(_):
    return True


def test_the_page_comes_whole_and_with_the_token_only(served):
    status, headers, text = served.get(f"/?token={served.server.token}")
    assert status == 200
    assert headers["Content-Type"].startswith("text/html")
    assert headers["Cache-Control"] == "no-store"
    assert "<canvas" in text
    assert "http://" not in text  # nothing from elsewhere
    assert "https://" not in text
    assert "<!--" not in text
    for path in ("/", "/?token=", "/?token=wrong", f"/?token={served.server.token}x", "/?token=%F0%9F%A4%96"):
        assert served.get(path)[0] == 403
    assert served.get(f"/etc/passwd?token={served.server.token}")[0] == 404


def test_a_foreign_name_of_this_computer_is_refused(served):
    """As pages of others use to get at servers on loopback."""
    assert served.get(f"/?token={served.server.token}", Host="evil.example:80")[0] == 403


@pytest.mark.parametrize("wrong", [{"token": "wrong"}, {"token": ""}, {"origin": "http://evil.example"},
                                   {"origin": "null"}, {"origin": "https://127.0.0.1"}])  # fmt: skip
def test_a_socket_with_a_wrong_token_or_of_a_foreign_origin_is_refused(served, wrong):
    with pytest.raises(InvalidStatus) as refused, served.socket(**wrong):
        pass
    assert refused.value.response.status_code == 403


def test_frames_come_and_time_goes_on(served):
    with served.socket() as socket:
        about = until(socket, always, "about")
        assert about["scene"] == "lemniscate"
        assert len(about["path"]) > 100
        first = until(socket, always)
        later = until(socket, lambda frame: frame["t"] > first["t"] + 0.2)
        assert later["n"] > first["n"]
        assert len(first["rods"]) == 2
        # A rod's centreline begins at its motor and ends at the tip.
        assert first["rods"][0][:2] == [-1000, 0]
        assert first["rods"][1][-2:] == pytest.approx([1e4 * p for p in first["p"]], abs=1)


def test_what_is_no_message_is_answered_and_harms_nothing(served):
    wrong = ["", "{", "[]", "null", '"do"', '{"do":1}', '{"do":"format"}', '{"do":"drag"}', '{"do":"drag","x":1}',
             '{"do":"drag","x":NaN,"y":0}', '{"do":"drag","x":1e9,"y":0}', '{"do":"drag","x":"1","y":0}',
             '{"do":"drag","x":true,"y":0}', '{"do":"pause","on":1}', '{"do":"set","name":[],"value":1}',
             '{"do":"reset","more":1}', '{"do":"reset","id":-1}', '{"do":"seen","n":1.5}', "[" * 1500,
             b"\x00\xff"]  # fmt: skip
    before = served.server.counts["wrong"]
    with served.socket() as socket:
        for text in wrong:
            socket.send(text)
            assert "message" in until(socket, always, "error")
        until(socket, always)
    assert served.server.counts["wrong"] == before + len(wrong)


def test_a_huge_message_closes_its_own_connection_only(served):
    with served.socket() as other, served.socket(max_size=None) as socket:
        socket.send("x" * (100 * LONGEST))
        deadline = time.monotonic() + PATIENCE
        with suppress(ConnectionClosed):
            while time.monotonic() < deadline:
                socket.recv(timeout=PATIENCE)
        assert socket.close_code in (1006, 1009)
        until(other, always)


def test_random_bytes_do_no_harm(served):
    chance = np.random.default_rng(0)
    for _ in range(5):
        with sockets.create_connection(served.server.address, timeout=2) as raw:
            raw.sendall(chance.bytes(300) + b"\r\n\r\n")
    with served.socket() as socket:
        until(socket, always)


def test_one_page_steers_and_others_look_on(served):
    with served.socket() as first:
        assert until(first, always, "role")["steers"]
        with served.socket() as second:
            role = until(second, always, "role")
            assert not role["steers"]
            assert role["pages"] == 2
            ask(second, do="pause", on=True)
            assert "take over" in until(second, always, "error")["message"]
            # Both see the same robot.
            ask(first, do="pause", on=True)
            mine, theirs = until(first, lambda f: f["paused"]), until(second, lambda f: f["paused"])
            assert mine["p"] == theirs["p"]
            ask(second, do="steer")
            assert until(second, lambda role: role["steers"], "role")
            assert until(first, lambda role: not role["steers"], "role")
            ask(second, do="pause", on=False)
            until(second, lambda f: not f["paused"])
        # Who is left may steer again, by steering.
        assert until(first, lambda role: role["free"], "role")
        ask(first, do="pause", on=False)
        assert until(first, lambda role: role["steers"], "role")


def test_a_page_that_closes_lets_go_of_the_robot_and_stops_nothing(served):
    with served.socket() as socket:
        ask(socket, do="drag", x=0.05, y=0.2)
        held = until(socket, lambda frame: frame["pull"])
    with served.socket() as again:
        frame = until(again, always)
        until(again, lambda frame: frame["pull"] is None)
        assert frame["t"] >= held["t"]


def test_errors_of_a_command_go_to_who_asked(served):
    with served.socket() as socket:
        ask(socket, do="controller", name="nobody", id=41)
        error = until(socket, always, "error")
        assert error["id"] == 41
        assert "nobody" in error["message"]


def test_a_recording_is_written(served, tmp_path):
    with served.socket() as socket:
        ask(socket, do="record", on=True)
        until(socket, lambda frame: frame["recording"] and frame["recording"] > 0.1)
        ask(socket, do="record", on=False)
        saved = until(socket, always, "saved")
    assert (Path(saved["folder"]) / "run.npz").is_file()


def test_a_page_that_does_not_draw_is_sent_no_more_and_misses_frames_not_time(served):
    counts = served.server.counts
    dropped, made = counts["dropped"], counts["frames"]
    with served.socket() as socket:
        got = []
        while counts["frames"] < made + 20:  # however long a busy machine takes for them
            try:
                message = json.loads(socket.recv(timeout=0.2))
            except TimeoutError:
                continue
            if message["kind"] == "frame":
                got.append(message)
        assert len(got) <= 5
        ask(socket, do="seen", n=got[-1]["n"])
        later = until(socket, always)
        assert later["n"] > got[-1]["n"] + 10  # the newest one, and none of those in between
        assert later["t"] > got[-1]["t"]
    assert counts["dropped"] > dropped


def test_news_is_not_dropped_with_frames():
    class Connection:
        pass

    page = Page(Connection())
    for number in range(5):
        page.offer(number, f"frame {number}")
        page.tell(f"news {number}")
    assert page.news == [f"news {number}" for number in range(5)]
    assert page.waiting == "frame 4"


def test_who_does_not_listen_is_hung_up_on():
    class Connection:
        class transport:
            aborted = False

            @classmethod
            def abort(cls):
                cls.aborted = True

    page = Page(Connection())
    for number in range(150):
        page.tell(f"news {number}")
    assert not Connection.transport.aborted
    for number in range(100):
        page.tell(f"news {number}")
    assert Connection.transport.aborted
    assert len(page.news) < 100


def test_only_loopback_unless_it_is_said():
    with pytest.raises(OutputError, match="loopback"):
        ViewServer(lambda: None, ("0.0.0.0", 0), Path())
    with pytest.raises(OutputError, match="loopback"):
        ViewServer(lambda: None, ("example.org", 0), Path())


def test_a_message_is_read_or_refused():
    assert read('{"do":"drag","x":0.1,"y":2,"id":3}') == {"do": "drag", "x": 0.1, "y": 2, "id": 3}
    with pytest.raises(MessageError, match="drag takes x, y"):
        read('{"do":"drag","x":0.1}')


def test_the_command_prints_the_address_and_ends_by_ctrl_c_with_nothing_left(tmp_path):
    command = [sys.executable, "-m", "pcr_mpc.cli", "view", "lemniscate", "--no-browser", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as process:
        for line in process.stderr:
            if "http://127.0.0.1:" in line:
                break
        address = line.split(": ", 1)[1].strip()
        assert "token=" in address
        host, port = address.split("/")[2].split(":")
        assert get(host, int(port), address[address.index("/?") :])[0] == 200
        process.send_signal(2)
        out, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130  # as all that is stopped by Ctrl-C
    assert json.loads(out)["scene"] == "lemniscate"
    assert "Traceback" not in err
    assert err.splitlines()[-1] == "lemniscate: ended"  # the way out that was named is no failure
    assert "Warning" not in err
    with pytest.raises(ConnectionRefusedError):
        get(host, int(port), "/")


def test_a_port_that_is_none_or_taken_is_said(served):
    with pytest.raises(OutputError, match="65535"):
        ViewServer(lambda: None, ("127.0.0.1", 65536), Path())
    second = ViewServer(lambda: pytest.fail("a robot was made"), served.server.address, Path())
    with pytest.raises(OutputError, match="--port"):
        second.serve(lambda _: None)


def test_what_takes_a_while_is_told_to_all(served):
    with served.socket() as socket:
        ask(socket, do="controller", name="lqr")
        assert until(socket, always, "busy")["on"]
        assert not until(socket, always, "busy")["on"]
        until(socket, lambda frame: frame["controller"] == "lqr")
        ask(socket, do="controller", name="lemniscate")
        until(socket, lambda frame: frame["controller"] == "lemniscate")


def test_without_websockets_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "websockets", None)
    with pytest.raises(PCRError, match=r"pcr_mpc\[view\]"):
        ViewServer(lambda: None, ("127.0.0.1", 0), Path())


def test_an_address_of_ipv6_is_one_that_browsers_take():
    server = ViewServer(lambda: None, ("::1", 8000), Path())
    assert server.url.startswith("http://[::1]:8000/?token=")
