"""Ctrl-C and its brothers: seen at the next step whoever swallows them, nothing half done, what is finished kept."""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from pcr_mpc import HoldMotors, SimulationError, interrupt, load_scene, simulate
from pcr_mpc.cli import main
from pcr_mpc.compiled import compiled
from pcr_mpc.study.choice.choice import choose
from pcr_mpc.study.episodes.parallel import as_finished, local_workers
from tests.conftest import CONTROLLERS, MODELS, ROOT
from tests.study.test_parallel import processes_of, wait_until

COMMAND = [sys.executable, "-m", "pcr_mpc.cli"]
linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="signals and processes as on Linux")


@pytest.fixture
def release():
    return replace(load_scene(MODELS / "scenes" / "release.toml"), duration=0.2)


class Pressed(HoldMotors):
    """Ctrl-C comes in period ``at``, inside a call that loses Python's exceptions."""

    def __init__(self, n_rods, at, kind=signal.SIGINT):
        super().__init__(n_rods)
        self.at, self.kind, self.steps = at, kind, 0

    def step(self, k, x):
        self.steps += 1
        if k == self.at:
            with contextlib.suppress(BaseException):  # as SWIG's type checks do
                os.kill(os.getpid(), self.kind)
        return super().step(k, x)


def test_a_signal_that_is_swallowed_is_seen_at_the_next_step(release):
    controller = Pressed(2, at=3)
    with interrupt.listening(), pytest.raises(SimulationError, match="interrupted") as caught:
        simulate(release, release.make_plant(), controller)
    assert isinstance(caught.value.__cause__, KeyboardInterrupt)
    assert controller.steps == 4
    assert len(caught.value.run.u) == 4
    interrupt.check()  # forgotten with the command that it was for
    assert simulate(release, release.make_plant(), HoldMotors(2)).events == []


def test_without_the_command_line_python_does_what_it_does(release):
    before = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
        interrupt.check()
        with interrupt.listening():
            assert signal.getsignal(signal.SIGINT) is not signal.default_int_handler
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)


def test_no_rung_is_chosen_once_it_is_interrupted(release, monkeypatch):
    """It was recorded as the failure of the rung in progress, and a wrong one was chosen."""
    calls = []

    def pressed(scene, *arguments, **keywords):
        calls.append(scene)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return simulate(scene, *arguments, **keywords)

    monkeypatch.setattr("pcr_mpc.study.choice.choice.simulate", pressed)
    with interrupt.listening(), pytest.raises(KeyboardInterrupt):
        choose(replace(release, duration=0.05))
    assert len(calls) == 3


def test_waiting_for_workers_ends_too():
    from concurrent.futures import Future

    with interrupt.listening():
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            list(as_finished([Future()]))


def test_another_program_ends_with_what_it_has_started():
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    began = time.monotonic()
    with interrupt.listening(), pytest.raises(KeyboardInterrupt):
        interrupt.completed(["sh", "-c", "sleep 60; true"])
    assert time.monotonic() - began < 30.0
    assert interrupt.completed(["sh", "-c", "echo said; exit 3"]).stdout == "said\n"


@linux
def test_a_worker_that_is_told_to_end_ends_the_compiler_that_it_waits_for(tmp_path):
    """It leaves Ctrl-C to its parent, which tells it by SIGTERM; the compiler is in a session of its own."""
    noted = tmp_path / "pid"
    script = (
        "import signal; from pcr_mpc import interrupt; signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        f"interrupt.completed(['sh', '-c', 'echo $$ > {noted}; sleep 60; true'])"
    )
    worker = subprocess.Popen([sys.executable, "-c", script])
    wait_until(lambda: noted.exists() and noted.read_text().endswith("\n"))
    compiler = Path(f"/proc/{noted.read_text().strip()}")
    assert compiler.exists()
    worker.send_signal(signal.SIGINT)
    worker.terminate()
    assert worker.wait(30.0) == 143
    wait_until(lambda: not compiler.exists())


@linux
def test_ctrl_c_while_machine_code_is_built_ends_the_compiler(tmp_path, monkeypatch):
    compiler = tmp_path / "cc"
    compiler.write_text("#!/bin/sh\n[ $1 = --version ] || sleep 60; true\n")
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    began, x = time.monotonic(), ca.SX.sym("x")
    with interrupt.listening(), pytest.raises(KeyboardInterrupt):
        compiled(ca.Function("slow", [x], [x**2]))
    assert time.monotonic() - began < 30.0
    assert not list((tmp_path / "cache" / "pcr_mpc").iterdir())


@pytest.mark.parametrize(("kind", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_track_keeps_what_it_has_and_exits_by_the_signal(tmp_path, monkeypatch, capsys, kind, status):
    monkeypatch.setattr("pcr_mpc.cli.track.make_controller", lambda scene, tuning: Pressed(2, 5, kind))
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        assert main(["track", str(MODELS / "scenes/release.toml"), "--out", str(tmp_path), "--json"]) == status
    finally:
        signal.signal(signal.SIGHUP, before)
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1].startswith("pcr-mpc: release stopped at t = ")
    assert "Traceback" not in captured.err
    with np.load(tmp_path / "run.npz") as stored:
        assert len(stored["u"]) == 6
    assert json.loads((tmp_path / "summary.json").read_text())["control_steps"] == 6
    assert not (tmp_path / "track.png").exists()


def run(arguments, **keywords):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.Popen([*COMMAND, *map(str, arguments)], env=environment, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE, text=True, **keywords)  # fmt: skip


@pytest.fixture
def vertical(tmp_path):
    shutil.copytree(MODELS, tmp_path / "models")
    shutil.copytree(CONTROLLERS, tmp_path / "controllers")
    return tmp_path / "models/scenes/vertical.toml"


def stopped(process, after, file):
    text = file.read_text()
    time.sleep(after)
    process.send_signal(signal.SIGINT)
    out, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert errors.splitlines()[-1].endswith("pcr-mpc: interrupted")
    assert "Traceback" not in errors
    assert out == ""
    assert file.read_text() == text


@linux
def test_choose_stops_at_once_while_modules_load(vertical):
    process = run(["choose", vertical, "--write"])
    # As soon as the package itself is loaded, which is soon: it loads no others before it listens.
    wait_until(lambda: _listens(process.pid))
    stopped(process, 0.05, vertical)


def _listens(pid):
    """Whether a process catches SIGTERM, by /proc."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("SigCgt:"):
            return bool(int(line.split()[1], 16) >> (signal.SIGTERM - 1) & 1)
    return False


@linux
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("command", ["choose", "timing", "track"])
def test_every_command_stops_at_any_moment_and_writes_nothing_wrong(vertical, tmp_path, command, seed):
    extra = {"choose": ["--write"], "timing": ["--out", tmp_path / "out"], "track": ["--out", tmp_path / "out"]}
    process = run([command, vertical, *extra[command]])
    wait_until(lambda: _listens(process.pid))
    text = vertical.read_text()
    time.sleep(random.Random(f"{command} {seed}").uniform(0.0, 6.0))
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert vertical.read_text() == text


@linux
def test_a_second_ctrl_c_ends_at_once():
    script = """
import sys, time
from pcr_mpc import interrupt
with interrupt.listening():
    print("ready", flush=True)
    while True:
        time.sleep(0.01)
        if interrupt.noted():
            print("noted", flush=True)
            time.sleep(60)
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen([sys.executable, "-c", script], env=environment, stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True)  # fmt: skip
    for word in ("ready", "noted"):
        assert process.stdout.readline().strip() == word
        process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=10)
    assert process.returncode == 130
    assert errors == "pcr-mpc: interrupted\n"


@linux
@pytest.mark.slow
def test_ctrl_c_in_a_terminal_leaves_no_workers_and_no_tracebacks(tmp_path):
    """It reaches all processes at once, those that are still loading, too."""
    script = tmp_path / "study.py"
    script.write_text(
        """
import pathlib, sys
from pcr_mpc import interrupt
from pcr_mpc.study.episodes.parallel import finished, local_workers
import time
if __name__ == "__main__":
    try:
        with interrupt.listening(), local_workers(2) as executor:
            list(finished(executor, time.sleep, [60.0] * 4, desc="test", unit="task"))
    except KeyboardInterrupt:
        sys.exit(130)
"""
    )
    study = subprocess.Popen([sys.executable, str(script)], cwd=ROOT, stderr=subprocess.PIPE, text=True,
                             env={**os.environ, "PYTHONPATH": str(ROOT)}, start_new_session=True)  # fmt: skip
    wait_until(lambda: len(processes_of(study.pid)) >= 2)
    workers = processes_of(study.pid)
    time.sleep(random.Random(4).uniform(0.0, 1.0))
    os.killpg(study.pid, signal.SIGINT)
    _, errors = study.communicate(timeout=30)
    assert study.returncode == 130, errors
    assert "Traceback" not in errors
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in workers))


def test_workers_end_with_what_they_were_opened_for():
    """What they are at is of no use to a caller who gives up, so nobody waits a minute for it."""
    began = time.monotonic()
    with contextlib.suppress(KeyError), local_workers(1) as executor:
        executor.submit(time.sleep, 60.0)
        raise KeyError
    assert time.monotonic() - began < 50.0  # of a task that takes 60 s


@linux
def test_a_reader_that_goes_away_is_no_failure_to_report():
    process = run(["statics", MODELS / "planar_pair.toml", "--p", 0, 0.25, "--mode", "LR"])
    process.stdout.close()
    with process.stderr:
        assert process.stderr.read() == ""
    assert process.wait(timeout=60) == 141


@linux
@pytest.mark.slow
def test_a_full_disk_for_the_table_is_one_clear_line():
    with open("/dev/full", "w") as full:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        arguments = ["statics", str(MODELS / "planar_pair.toml"), "--p", "0", "0.25", "--mode", "LR"]
        done = subprocess.run([*COMMAND, *arguments], env=environment, stdout=full, stderr=subprocess.PIPE, text=True,
                              check=False)  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.splitlines() == ["pcr-mpc: [Errno 28] No space left on device"]
