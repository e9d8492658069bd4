"""What is refused where nothing ordinary leads: each says what happened, with numbers and the next step."""

import math
import os
import pickle

import numpy as np
import pytest

from pcr_mpc import ConvergenceError, ModelError, PCRError, Plant, forward_statics, load_robot, load_scene
from pcr_mpc.buffered import BufferedFunction
from pcr_mpc.cli.study import _ended
from pcr_mpc.compiled import compiled
from pcr_mpc.control.nonlinear.nonlinear_mpc import NonlinearMPC
from pcr_mpc.control.qp.daqp_solver import DAQPSolver
from pcr_mpc.control.qp.osqp_solver import QPSolver
from pcr_mpc.control.qp.program import constraint_matrix
from pcr_mpc.errors import CompilerError, OutputError
from pcr_mpc.files import require_free
from pcr_mpc.linearisation.linear_model import column_size, n_states
from pcr_mpc.plant.motion import distributed
from pcr_mpc.plant.mujoco import hinge_chain
from pcr_mpc.plant.rods import snap
from pcr_mpc.plant.statics import balance, free_tip, solver
from pcr_mpc.plant.statics.single_shooting import SingleShooting
from pcr_mpc.study.choice import choice
from tests.conftest import MODELS

SCENES = MODELS / "scenes"


def test_a_graph_with_memory_of_its_own_cannot_be_pickled():
    import casadi as ca

    x = ca.SX.sym("x")
    with pytest.raises(TypeError, match=r"the graph 'double' writes into memory.*pickle the plant"):
        pickle.dumps(BufferedFunction(ca.Function("double", [x], [2 * x])))


def test_a_nonlinear_mpc_cannot_be_pickled(pair, centre):
    from pcr_mpc.control.motor_limits import Limits
    from pcr_mpc.plant.statics.symbolic import rod_unknowns, symbolic_dynamics

    hands, algebraic = rod_unknowns(pair, centre)
    tuning = load_scene(SCENES / "lemniscate.toml").tuning
    mpc = NonlinearMPC(tuning, Limits(6.0, 3.0, *pair.angle_limits.T), symbolic_dynamics(pair, hands), algebraic)
    with pytest.raises(TypeError, match=r"NonlinearMPC holds a function.*pickle its controller instead"):
        pickle.dumps(mpc)


def test_a_column_that_is_no_model_is_told():
    assert [n_states(column_size(n)) for n in (5, 6, 7)] == [5, 6, 7]
    with pytest.raises(ValueError, match="a column of 67 numbers holds no linear model"):
        n_states(67)


def test_a_cache_without_room_is_a_failed_compiler(compiler, monkeypatch):
    import casadi as ca

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    x = ca.SX.sym("x")
    with pytest.raises(CompilerError, match=r"thrice.*No space left on device"):
        compiled(ca.Function("thrice", [x], [3 * x + math.pi * os.getpid()]))  # not in the cache yet


def test_places_that_cannot_be_written_are_named(tmp_path, monkeypatch):
    (tmp_path / "made").mkdir()
    with pytest.raises(OutputError, match=r"made: is a folder, a file is wanted; name one in it") as caught:
        require_free(tmp_path / "made")
    assert caught.value.path == str(tmp_path / "made")

    def refused(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.mkdir", refused)
    with pytest.raises(OutputError, match=r"new: cannot be made: Permission denied") as caught:
        require_free(tmp_path / "new" / "file.toml")
    assert caught.value.path == str(tmp_path / "new")


def test_tables_of_a_file_are_tables(tmp_path):
    text = (MODELS / "planar_pair.toml").read_text()
    path = tmp_path / "robot.toml"
    path.write_text("rods = [1, 2]\n" + text[: text.index("[[rods]]")])
    with pytest.raises(ModelError, match=r"robot\.toml: rods: expected \[\[rods\]\] tables, found \[1, 2\]"):
        load_robot(path)
    scene = (SCENES / "release.toml").read_text().replace('"../', f'"{MODELS}/')
    (tmp_path / "scene.toml").write_text("world = 3\n" + scene.replace("[world]", "[elsewhere]"))
    with pytest.raises(ModelError, match=r"scene\.toml: world: expected a table, found 3"):
        load_scene(tmp_path / "scene.toml")


def test_no_record_is_kept_by_single_shooting(pair):
    with pytest.raises(ValueError, match="method single_shooting keeps no record"):
        Plant(pair, method="single_shooting").record  # noqa: B018
    with pytest.raises(RuntimeError, match=r"no pose to start from: call start \(or Plant\.reset\) first"):
        SingleShooting(pair).drift()


def test_iterations_that_run_out_are_counted(pair, centre, monkeypatch):
    """Each search with too few: the error carries how many, how far, and where it was."""
    monkeypatch.setattr(balance, "_MAX_ITERATIONS", 1)
    with pytest.raises(ConvergenceError, match=r"no stable pose found.*did not settle in 1 iterations, last at p = "):
        forward_statics(pair, centre.q + [0.4, -0.6])
    rods = free_tip._solver(pair)
    rods.start(centre.p + [0.05, 0.0], centre.q)
    with pytest.raises(ConvergenceError, match=r"settle in 1 iterations.*pass a guess") as caught:
        balance.settle(rods, centre.p + [0.05, 0.0], centre.q, np.zeros(2))
    assert (caught.value.iterations, caught.value.last.shape) == (1, (2,))
    assert 0.0 < np.linalg.norm(caught.value.last - centre.p) < 0.05  # it came nearer
    assert caught.value.residual > 0.0

    monkeypatch.setattr(hinge_chain, "_MOST_ITERATIONS", 1)
    with pytest.raises(ConvergenceError, match=r"a chain of 12 links did not settle.*use more links") as caught:
        hinge_chain.settled_chains(centre, np.zeros(2), 12)
    assert (caught.value.iterations, caught.value.last.shape) == (1, (12,))

    monkeypatch.setattr(distributed, "_MOST_ITERATIONS", 1)
    rods = distributed.DistributedRods(pair, 12)
    with pytest.raises(ConvergenceError, match=r"did not settle; use more modes"):
        rods.settled(centre.p, np.zeros(2), centre.q, centre.nodes)


def test_a_snap_that_does_not_end_is_an_error_and_the_plant_stays(pair, centre, monkeypatch):
    x = np.concatenate([centre.p, [0, 0], centre.q])

    def wound(plant):
        plant.reset(x, centre)
        return plant.force(centre.p, centre.q + [5.0, 0.0])

    with monkeypatch.context() as patch:
        patch.setattr(snap, "_MAX_STEPS", 2)
        with pytest.raises(PCRError):
            wound(Plant(pair, on_snap="jump"))
    with monkeypatch.context() as patch:
        patch.setattr(solver, "_MOST_SNAPS", 0)
        with pytest.raises(ConvergenceError, match="snapped 0 times in a row"):
            wound(Plant(pair, on_snap="jump"))
    plant = Plant(pair, on_snap="jump")
    assert np.isfinite(wound(plant)).all()
    assert len(plant.snaps) == 1


def test_a_scene_without_any_rung_says_why(monkeypatch):
    scene = load_scene(SCENES / "release.toml")

    def none(self, robot):
        raise PCRError("not today")

    monkeypatch.setattr(type(scene.plant), "make", none)
    with pytest.raises(PCRError, match="release: no rung can be simulated: not today"):
        choice.Bench(scene)


def test_what_a_solver_refuses_is_not_passed_over():
    qp = QPSolver(constraint_matrix(2, 2), 1e-5, 100)
    with pytest.raises(RuntimeError, match="OSQP refused warm_start with code 3; the old data are still in place"):
        qp._refused("warm_start", 3)
    with pytest.raises(
        RuntimeError, match="DAQP refused update with code -3; the data are lost, call update with good"
    ):
        DAQPSolver(constraint_matrix(2, 2))._require(-3, "update")


def test_a_command_whose_results_are_elsewhere_fails_with_the_place(tmp_path):
    assert _ended("", tmp_path) == 0
    with pytest.raises(OutputError, match="disk full; the results are in") as caught:
        _ended("disk full; the results are in another folder", tmp_path)
    assert caught.value.path == str(tmp_path)
