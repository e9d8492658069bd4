"""Machine code: the same bits, built once, and never from a place that others could write to."""

import os
import re
import shutil
import stat
import subprocess
import sys
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

from pcr_mpc import CompilerError, PCRError, Plant
from pcr_mpc.buffered import BufferedFunction, listed
from pcr_mpc.compiled import compiled, fastest, has_compiler
from pcr_mpc.plant.rods.closed_form.elastica import rod_newton

NOT_ROOT = pytest.mark.skipif(hasattr(os, "getuid") and os.getuid() == 0, reason="root may write anywhere")


def graph(factor=2.0, name="small"):
    x = ca.SX.sym("x", 2)
    return ca.Function(name, [x], [factor * ca.sin(x) / (1 + x[0] ** 2)])


@pytest.fixture
def folder(compiler, monkeypatch, tmp_path):
    """An empty cache, before it is made."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "pcr_mpc"


def built(folder):
    return sorted(path.name for path in folder.iterdir())


def value(function):
    return function([0.3, -0.7]).full()


def test_the_same_bits(compiler):
    """Of a graph with all that the plant is made of; that of a whole step is in test_rollout."""
    newton = rod_newton(any_pull=True)[0]
    code, rng = compiled(newton), np.random.default_rng(0)
    for _ in range(200):
        arguments = [*rng.uniform((-40.0, 0.1), (1.0, 60.0)), rng.choice([-1.0, 1.0])], rng.uniform(-1.0, 1.0, 3)
        for mine, theirs in zip(code(*arguments), newton(*arguments), strict=True):
            assert np.array_equal(mine.full(), theirs.full(), equal_nan=True)


def test_built_once_and_said_so(folder, capfd):
    first = compiled(graph())
    said = capfd.readouterr()
    assert said.out == ""
    assert re.fullmatch(r"building machine code of 'small' \(\d+ kB of C\), once\n", said.err)
    (name,) = built(folder)
    before = (folder / name).stat()
    again = compiled(graph())
    assert capfd.readouterr().err == ""
    assert (folder / name).stat().st_mtime_ns == before.st_mtime_ns
    assert built(folder) == [name]
    assert (value(first) == value(graph())).all()
    assert (value(again) == value(graph())).all()
    # Nobody else is let in.
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert stat.S_IMODE(folder.parent.stat().st_mode) == 0o700
    assert not before.st_mode & 0o077


SCRIPT = """
import casadi as ca
from pcr_mpc.buffered import BufferedFunction
from pcr_mpc.compiled import compiled
x = ca.SX.sym("x", 2)
print(*compiled(ca.Function("small", [x], [2.0 * ca.sin(x) / (1 + x[0] ** 2)]))([0.3, -0.7]).full().ravel())
"""


def start():
    return subprocess.Popen([sys.executable, "-c", SCRIPT], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def finish(process):
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    return [float(number) for number in out.split()], err


def test_another_process_loads_it(folder):
    expected = value(graph()).ravel().tolist()
    compiled(graph())
    names = built(folder)
    assert finish(start()) == (expected, "")
    assert built(folder) == names


def test_two_processes_at_once(folder):
    expected = value(graph()).ravel().tolist()
    processes = [start() for _ in range(3)]
    for process in processes:
        assert finish(process)[0] == expected
    names = built(folder)
    assert len({name.split("-")[0] for name in names}) == 1
    assert all(name.endswith(".so") for name in names)  # nothing half done is left
    assert finish(start()) == (expected, "")


def test_another_version_of_the_compiler_builds_anew(folder, compiler, monkeypatch, tmp_path):
    wrapper, real = tmp_path / "wrapped", shutil.which(compiler.split()[0])
    monkeypatch.setenv("CC", str(wrapper))
    for count, version in enumerate(("1", "2")):
        wrapper.write_text(f'#!/bin/sh\n[ "$1" = --version ] && echo {version} && exit\nexec {real} "$@"\n')
        wrapper.chmod(0o755)
        assert "building" in finish(start())[1]
        assert len({name.split("-")[0] for name in built(folder)}) == count + 1


def test_a_change_of_source_flags_compiler_or_machine_builds_anew(folder, compiler, monkeypatch):
    def key():
        before = set(built(folder)) if folder.exists() else set()
        assert (value(compiled(graph())) == value(graph())).all()
        new = set(built(folder)) - before
        assert len(new) == 1
        return new.pop().split("-")[0]

    keys = [key()]
    assert (value(compiled(graph(3.0))) == value(graph(3.0))).all()
    assert len(built(folder)) == 2
    monkeypatch.setattr("pcr_mpc.compiled._FLAGS", ("-O0", "-ffp-contract=off", "-fPIC", "-shared"))
    keys.append(key())
    with monkeypatch.context() as long:  # what is long is compiled in another way, to the same bits
        long.setattr("pcr_mpc.compiled._LONG", 0)
        keys.append(key())
    monkeypatch.setenv("CC", f"{compiler} -DANYTHING")
    keys.append(key())
    monkeypatch.setattr("platform.machine", lambda: "another")
    keys.append(key())
    assert len(set(keys)) == len(keys)


@pytest.mark.parametrize("how", ["cut", "changed", "empty", "unreadable", "renamed"])
def test_a_spoilt_file_is_rebuilt(folder, how, capfd):
    compiled(graph())
    (name,) = built(folder)
    path, whole = folder / name, (folder / name).read_bytes()
    # A new file, for the one that is loaded must stay as it is.
    path.unlink()
    spoilt = {"cut": whole[: len(whole) // 2], "empty": b"", "unreadable": b"", "renamed": b"no library"}
    path.write_bytes(spoilt.get(how, whole[:-100] + bytes(100)))
    path.chmod(0 if how == "unreadable" else 0o700)
    if how == "renamed":
        path = path.rename(folder / f"{name.split('-')[0]}-{'0' * 32}.so")
    capfd.readouterr()
    assert (value(compiled(graph())) == value(graph())).all()
    assert "building" in capfd.readouterr().err
    assert built(folder) == [name]
    assert (folder / name).read_bytes() == whole


@pytest.mark.parametrize("mode", [0o720, 0o702, 0o777])
def test_a_file_that_others_could_write_is_not_loaded(folder, mode, capfd):
    compiled(graph())
    (name,) = built(folder)
    inode = (folder / name).stat().st_ino
    (folder / name).chmod(mode)
    capfd.readouterr()
    assert (value(compiled(graph())) == value(graph())).all()
    assert "building" in capfd.readouterr().err
    found = (folder / name).stat()
    assert (found.st_ino, found.st_mode & 0o077) != (inode, mode & 0o077)
    assert not found.st_mode & 0o022


def test_a_link_to_a_file_elsewhere_is_not_loaded(folder, tmp_path, capfd):
    compiled(graph())
    (name,) = built(folder)
    (folder / name).rename(tmp_path / "elsewhere.so")
    (folder / name).symlink_to(tmp_path / "elsewhere.so")
    capfd.readouterr()
    compiled(graph())
    assert "building" in capfd.readouterr().err
    assert not (folder / name).is_symlink()


def open_folder(folder, tmp_path):
    folder.chmod(0o777)


def open_parent(folder, tmp_path):
    folder.parent.chmod(0o770)


def open_ancestor(folder, tmp_path):
    tmp_path.chmod(0o707)


def link_to_open(folder, tmp_path):
    """The folder itself is mine alone, but others could replace it."""
    (tmp_path / "open" / "own").mkdir(parents=True, mode=0o700)
    (tmp_path / "open").chmod(0o777)
    shutil.rmtree(folder.parent)
    folder.parent.symlink_to(tmp_path / "open" / "own")


def foreign(folder, tmp_path):
    os.chown(folder, 12345, 12345)


def foreign_parent(folder, tmp_path):
    os.chown(folder.parent, 12345, 12345)


ROOT = pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root gives files away")


@pytest.mark.parametrize(
    "spoil",
    [open_folder, open_parent, open_ancestor, link_to_open, pytest.param(foreign, marks=ROOT),
     pytest.param(foreign_parent, marks=ROOT)],
)  # fmt: skip
def test_a_folder_that_others_could_write_is_not_used(folder, tmp_path, spoil, capfd):
    folder.mkdir(parents=True, mode=0o700)
    compiled(graph())
    kept = built(folder) if spoil is not link_to_open else []
    spoil(folder, tmp_path)
    capfd.readouterr()
    try:
        for _ in range(2):
            assert (value(compiled(graph())) == value(graph())).all()
            assert "building" in capfd.readouterr().err
        assert built(folder) == kept if folder.exists() else not kept
    finally:
        tmp_path.chmod(0o700)


def test_a_sticky_folder_like_tmp_is_no_danger(folder, capfd):
    folder.mkdir(parents=True, mode=0o700)
    folder.parent.chmod(0o1777)
    compiled(graph())
    assert len(built(folder)) == 1
    capfd.readouterr()
    compiled(graph())
    assert capfd.readouterr().err == ""


def test_a_lax_umask_makes_no_lax_files(folder, capfd):
    before = os.umask(0o000)
    try:
        compiled(graph())
        capfd.readouterr()
        compiled(graph())
    finally:
        os.umask(before)
    assert capfd.readouterr().err == ""  # loaded


@pytest.mark.parametrize("where", ["file", "relative"])
def test_without_a_cache_folder_it_is_built_all_the_same(folder, tmp_path, monkeypatch, where, capfd):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    if where == "file":
        folder.parent.write_text("in the way")
    else:
        # The specification of XDG_CACHE_HOME wants that to be ignored.
        monkeypatch.setenv("XDG_CACHE_HOME", "somewhere")
        monkeypatch.chdir(tmp_path)
    assert (value(compiled(graph())) == value(graph())).all()
    assert "building" in capfd.readouterr().err
    assert not (tmp_path / "somewhere").exists()
    assert (tmp_path / "home" / ".cache" / "pcr_mpc").exists() == (where == "relative")


@NOT_ROOT
def test_a_folder_that_cannot_be_written_is_not_used(folder):
    folder.mkdir(parents=True, mode=0o500)
    assert (value(compiled(graph())) == value(graph())).all()
    assert built(folder) == []


@pytest.mark.parametrize("command", ["", "no-such-compiler", "'unfinished"])
def test_without_a_compiler_the_fastest_is_the_interpreter(folder, monkeypatch, command, capfd):
    monkeypatch.setenv("CC", command)
    assert not has_compiler()
    function = graph()
    assert fastest(function) is function
    with pytest.raises(CompilerError, match=r"cannot compile small with .*set CC to a C compiler"):
        compiled(function)
    assert not folder.exists()
    assert capfd.readouterr().err == ""


def test_the_fastest_is_machine_code_if_that_is_wanted(folder):
    function = graph()
    assert has_compiler()
    assert fastest(function, wanted=False) is function
    assert not folder.exists()
    code = fastest(function)
    assert code is not function
    assert len(built(folder)) == 1
    assert (value(code) == value(function)).all()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("echo 'out of coffee' >&2; exit 3", "out of coffee"),
        ("exit 3", "status 3"),
        ("exit 0", "status 0"),  # and made nothing
        ('[ "$1" = --version ] || echo junk > "$(echo "$*" | sed "s/.* -o \\([^ ]*\\).*/\\1/")"', "small"),
    ],
    ids=["says why", "silent", "makes nothing", "makes junk"],
)
def test_a_compiler_that_fails_is_an_error_with_what_it_said(folder, monkeypatch, tmp_path, lines, message):
    broken = tmp_path / "broken"
    broken.write_text(f"#!/bin/sh\n{lines}\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    with pytest.raises(CompilerError, match=message) as caught:
        compiled(graph())
    error = caught.value
    assert isinstance(error, PCRError)
    assert error.command == [str(broken)]
    assert "set CC" in str(error)


def test_machine_code_is_dense_whatever_the_graph_is(folder):
    """Else each call goes through what makes it dense, interpreted; names and numbers stay."""
    x = ca.SX.sym("x", 3)
    sparse = ca.Function("diagonal", [x], [ca.diag(x), x[0]], ["x"], ["square", "first"])
    code = fastest(sparse)
    assert code.name_out() == ["square", "first"]
    assert code.sparsity_out(0).is_dense()
    buffered = BufferedFunction(code)
    assert buffered.function is code
    buffered.inputs[0][:] = 1.0, 2.0, 3.0
    buffered()
    np.testing.assert_array_equal(buffered.outputs[0], np.diag([1.0, 2.0, 3.0]))


def test_a_list_of_instructions_gives_the_same_bits_as_calls():
    """CasADi makes x of x / y * y where it sees both operations."""
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    divided = ca.Function("divided", [x, y], [x / y])
    i, j = ca.MX.sym("i"), ca.MX.sym("j")
    calls = ca.Function("calls", [i, j], [divided(i, j) * j], ["x", "y"], ["product"])
    instructions = listed(calls)
    assert instructions.is_a("SXFunction")
    assert instructions.name_in() == ["x", "y"]
    assert float(instructions(1.0, 49.0)) == float(calls(1.0, 49.0)) == 1.0 / 49.0 * 49.0 != 1.0
    assert ca.GlobalOptions.getSimplificationOnTheFly()


def test_nothing_is_compiled_by_default(pair):
    """In these tests, that is: a plant does only if it is told to."""
    assert os.environ["CC"] == ""
    assert not has_compiler()
    with pytest.raises(CompilerError, match="no such compiler"):
        Plant(pair, compiled=True, dt=0.71e-3).step([0.0, 0.25, 0, 0, 3.37, -0.23], (0, 0))


def test_the_home_folder_is_the_place_where_nothing_is_said(compiler, monkeypatch, tmp_path):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    compiled(graph())
    assert len(built(Path(tmp_path) / ".cache" / "pcr_mpc")) == 1
