"""Folders of generated C, made once, and how they are compiled."""

import os
import shutil
import subprocess

import pytest

from pcr_mpc.cli import main
from tests.conftest import ROOT

SCENES = ROOT / "models" / "scenes"
CC = os.environ.get("CC") or "gcc"
needs_compiler = pytest.mark.skipif(
    not (shutil.which(CC) and shutil.which("make")), reason="generated C is compiled here: needs gcc and make"
)
# Quick to build; no optimisation may change a bit of what it computes.
QUICK = ["CFLAGS=-O0", "GRAPH_CFLAGS=-O0"]
INCLUDED = ["-isystem", "osqp/public", "-isystem", "osqp/private", "-isystem", "daqp/include"]


def generated(scene, folder, solver="osqp"):
    assert main(["generate", str(SCENES / f"{scene}.toml"), "--solver", solver, "--out", str(folder)]) == 0
    return folder


def make(folder, *words):
    done = subprocess.run(["make", "-s", "-C", str(folder), f"CC={CC}", *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "warning" not in done.stderr, done.stderr
    return folder


def run(folder, *words, **more):
    """Standard output of the example, whose exit status says whether all is as recorded."""
    done = subprocess.run([str(folder / "example"), *words], capture_output=True, text=True, **more)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="session")
def lemniscate(tmp_path_factory):
    return generated("lemniscate", tmp_path_factory.mktemp("c") / "lemniscate")


@pytest.fixture(scope="session")
def by_daqp(tmp_path_factory):
    return generated("lemniscate", tmp_path_factory.mktemp("daqp") / "lemniscate", "daqp")


@pytest.fixture(params=["osqp", "daqp"])
def each(request):
    """A folder for each solver."""
    return request.getfixturevalue({"osqp": "lemniscate", "daqp": "by_daqp"}[request.param])


def copied(folder, tmp_path):
    return shutil.copytree(folder, tmp_path / "copy", ignore=shutil.ignore_patterns("*.o", "*.a", "example"))
