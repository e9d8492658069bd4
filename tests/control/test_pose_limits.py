"""Limits of poses: their gradients, the QP that keeps them, and the loop that does."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from pcr_mpc import (
    LinearMPC,
    ModelError,
    Plant,
    SimulationError,
    assess_stability,
    linearise,
    load_scene,
    load_tuning,
    make_controller,
    simulate,
    solve_statics,
)
from pcr_mpc.control.motor_limits import Limits
from pcr_mpc.control.mpc import terminal_weight
from pcr_mpc.control.qp.limited import LimitedQP
from pcr_mpc.control.qp.program import Reference, build_qp
from pcr_mpc.control.qp.workspace import Check
from pcr_mpc.linearisation.linear_limits import LinearLimits
from pcr_mpc.linearisation.linear_model import LinearModels
from pcr_mpc.linearisation.pose_limits import LimitWatch, PoseLimits
from pcr_mpc.loop.references.trajectory import PickAndPlace
from pcr_mpc.plant.rods.closed_form import elastica
from tests.conftest import CONTROLLERS, MODELS

DT = 0.01
STRICT = PoseLimits(0.5, (-0.1, 0.0), (0.1, 0.3), rod_margin=0.6, stiffness=100.0)


@pytest.fixture(scope="module")
def scene():
    return replace(load_scene(MODELS / "scenes" / "lemniscate.toml"), duration=1.5)


def quantities(eq):
    """What the rows of `STRICT` measure, by the public statics."""
    stability = assess_stability(eq)
    return np.concatenate(
        [eq.motor_torque / 0.5, eq.p / 0.4, stability.rod_margins, stability.stiffness_eigenvalues[:1] / 100.0]
    )


def test_rows_are_values_and_gradients(pair, poses):
    for pose in poses:
        watch = LimitWatch(STRICT, Plant(pair))
        x = np.concatenate([pose.p, [0.3, -0.2], pose.q])
        watch.reset(x, pose)
        rows = watch.rows(x)
        assert rows is not None
        assert rows.kinds == ("torque",) * 2 + ("tip region",) * 2 + ("rod margin",) * 2 + ("stiffness",)
        assert rows.scale == pytest.approx([0.5, 0.5, 0.4, 0.4, 1.0, 1.0, 100.0])
        value = quantities(pose)
        limit = np.array([1.0, 1.0, 0.25, 0.75, 0.6, 0.6, 1.0])
        slack = np.where(np.isfinite(rows.upper), rows.upper, rows.lower) - rows.C @ x
        assert slack == pytest.approx(limit - value, abs=1e-8)
        h, slopes = 5e-7, np.zeros((7, 6))
        for j in (0, 1, 4, 5):
            ahead, back = x.copy(), x.copy()
            ahead[j] += h
            back[j] -= h
            ends = [quantities(solve_statics(pair, at[:2], at[4:], guess=pose)) for at in (ahead, back)]
            slopes[:, j] = (ends[0] - ends[1]) / (2 * h)
        assert rows.C == pytest.approx(slopes, abs=1e-6 * np.abs(slopes).max() + 1e-5)


def test_third_derivatives_of_the_energy_commute(pair, poses):
    """d/dx_k of d2U/dx_i dx_j is the same in every order: a check that no finite difference makes."""
    plant = Plant(pair)
    for pose in poses:
        plant.reset(np.concatenate([pose.p, [0, 0], pose.q]), pose)
        state = plant.rods(pose.p, pose.q)
        for i in range(2):
            third = elastica.rod_curvature()(state.unknowns[:, i], state.poses[:, i]).full()[:, :2].reshape(2, 2, 2)
            for order in ((0, 2, 1), (1, 0, 2), (2, 1, 0)):
                assert third == pytest.approx(third.transpose(order), rel=1e-8, abs=1e-8)


def test_limits_that_are_far_cost_nothing(pair, centre):
    watch = LimitWatch(PoseLimits(1.5, None, None, 0.05, 1.5), Plant(pair))
    x = np.concatenate([centre.p, [0, 0], centre.q])
    watch.reset(x, centre)
    assert watch.rows(x) is None


@pytest.fixture(scope="module")
def problem(pair, centre):
    """A QP about the centre whose unlimited plan breaks the limits of `limits`."""
    tuning = replace(load_tuning(CONTROLLERS / "default.toml"), horizon=6, tolerance=1e-9, max_iterations=100_000)
    x = np.concatenate([centre.p + [0.01, -0.01], [0.0, 0.0], centre.q])
    plant = Plant(pair)
    plant.reset(x, centre)
    model = linearise(plant, x, (0.0, 0.0), DT)
    motors = Limits(6.0, 3.0, *pair.angle_limits.T)
    reference = Reference(np.tile(np.concatenate([centre.p, [0, 0], centre.q]), (6, 1)), np.zeros((6, 2)))
    qp = build_qp(x, model, reference, np.zeros(2), tuning, motors, terminal_weight(model, tuning))
    return tuning, x, model, qp


def rows_for(x, model, p_high):
    """The tip may not come above p_high: the free response, which lies above, must be turned round."""
    return LinearLimits(
        ("tip region",), np.eye(1, 6, 1) / 0.4, np.array([-np.inf]), np.array([p_high / 0.4]), np.array([0.4])
    )


def test_limited_qp_against_another_solver(problem):
    """The optimum of the limited problem, by SciPy's SLSQP on the plain problem."""
    tuning, x, model, qp = problem
    free = LimitedQP(tuning, 2, DT, reach=model.reach).solve(qp, x, LinearModels.of([model]), None, soft_angles=False)
    check = Check(6, 2)
    highest = check.states(x, LinearModels.of([model]), free.inputs)[1:, 1].max()
    limits = rows_for(x, model, highest - 5e-4)
    answer = LimitedQP(tuning, 2, DT, limits.kinds, reach=model.reach).solve(
        qp, x, LinearModels.of([model]), limits, soft_angles=False
    )
    assert "tip region" in answer.active
    assert answer.slack == {}
    size = len(qp.q)
    hessian = np.zeros((size, size))
    hessian[np.tril_indices(size)] = qp.P
    hessian += np.tril(hessian, -1).T
    rows = qp.A.toarray()

    def tip(u):
        return (highest - 5e-4 - check.states(x, LinearModels.of([model]), u)[1:, 1]) * 1e3

    found = minimize(
        lambda u: u @ hessian @ u / 2 + qp.q @ u,
        free.inputs,
        jac=lambda u: hessian @ u + qp.q,
        method="SLSQP",
        constraints=[
            {"type": "ineq", "fun": lambda u: qp.u - rows @ u},
            {"type": "ineq", "fun": lambda u: rows @ u - qp.l},
            {"type": "ineq", "fun": tip},
        ],
        options={"ftol": 1e-14, "maxiter": 500},
    )
    assert found.success
    assert answer.inputs == pytest.approx(found.x, abs=1e-3)
    assert np.abs(answer.inputs - free.inputs).max() > 0.05


def test_what_cannot_be_kept_gives_way_and_is_reported(problem):
    tuning, x, model, qp = problem
    limits = rows_for(x, model, x[1] - 0.02)  # it starts 20 mm outside
    answer = LimitedQP(tuning, 2, DT, limits.kinds, reach=model.reach).solve(
        qp, x, LinearModels.of([model]), limits, soft_angles=False
    )
    states = Check(6, 2).states(x, LinearModels.of([model]), answer.inputs)
    assert answer.slack["tip region"] == pytest.approx(states[1:, 1].max() - (x[1] - 0.02), rel=1e-3)


def run(scene, **limits):
    scene = replace(scene, pose_limits=replace(scene.pose_limits, **limits))
    return simulate(scene, scene.make_plant(), make_controller(scene))


def test_tip_region_is_kept_in_closed_loop(scene):
    found = run(scene, tip_lower=(-0.045, 0.2), tip_upper=(0.045, 0.27))
    assert np.abs(found.x[:, 0]).max() < 0.045 + 2e-5
    assert found.x[:, 1].max() < 0.27 + 2e-5
    summary = found.summary()
    assert summary["control_rungs"] == {"solved": 150}
    assert summary["active_limits"]["tip region"] > 30
    assert summary["limit_violations"] == 0


def test_torque_is_kept_in_closed_loop(scene):
    free = run(scene)
    found = run(scene, torque=0.78)
    assert free.peak_torque > 0.82
    assert found.peak_torque < 0.78 + 2e-3
    assert found.summary()["failures"] == 0


def test_the_controller_does_not_drive_through_a_fold(pair):
    """Down to where the branch all but ends, under a load that nobody told the controller of."""
    wide = ((0.3, 6.3), (-3.15, 2.85))
    robot = replace(
        pair,
        rods=tuple(replace(rod, angle_limits=stops) for rod, stops in zip(pair.rods, wide, strict=True)),
        torque_limit=5.0,
    )
    scene = replace(
        load_scene(MODELS / "scenes" / "lemniscate.toml"),
        robot=robot,
        duration=2.2,
        trajectory=PickAndPlace((0.0, 0.25), (0.0, 0.02), 0.0, 0.2, 1.5),
        force=(5.0, 5.0),
        tuning=load_tuning(CONTROLLERS / "frozen.toml"),
        pose_limits=PoseLimits(),
        tracking_error=0.3,  # where the branch ends is far from where it should go
    )
    with pytest.raises(SimulationError, match="its branch ends"):
        run(scene)
    found = run(scene, stiffness=20.0, rod_margin=0.1)
    assert found.verdict() == ""
    plant = Plant(robot)
    plant.reset(found.x[0], found.pose)
    verdicts = [assess_stability(plant.equilibrium(x)) for x in found.x[::40]]
    assert min(v.stiffness_eigenvalues[0] for v in verdicts) > 18.0
    assert min(v.rod_margins.min() for v in verdicts) > 0.095
    assert found.summary()["active_limits"]["stiffness"] > 50


def test_pose_limits_in_a_scene(tmp_path):
    text = (MODELS / "scenes" / "lemniscate.toml").read_text()
    for folder in ("models", "controllers"):
        text = text.replace(f'"../../{folder}', f'"{(MODELS.parent / folder).as_posix()}')
    text = text.replace('"../planar_pair', f'"{MODELS.as_posix()}/planar_pair')
    path = tmp_path / "scene.toml"
    path.write_text(text + "\n[limits]\ntorque = 1.0\nrod_margin = 0.2\nstiffness = 0\n")
    assert load_scene(path).pose_limits == PoseLimits(torque=1.0, rod_margin=0.2, strain=(0.0085, 0.0085))
    path.write_text(text + "\n[limits]\ntip_lower = [0.0, 0.0]\n")
    with pytest.raises(ModelError, match="both tip_lower and tip_upper"):
        load_scene(path)


def test_plan_names_what_shapes_it(pair, centre):
    tuning = replace(load_tuning(CONTROLLERS / "default.toml"), max_iterations=4000)
    x = np.concatenate([centre.p, [0, 0], centre.q])
    plant = Plant(pair)
    plant.reset(x, centre)
    model = linearise(plant, x, (0.0, 0.0), DT)
    reference = Reference(np.tile(x, (tuning.horizon, 1)), np.zeros((tuning.horizon, 2)))
    far = x + np.array([0.02, -0.03, 0, 0, 0, 0])
    for limits, expected in (
        (Limits(9.0, 99.0, *pair.angle_limits.T), ()),
        (Limits(1.5, 99.0, *pair.angle_limits.T), ("rate",)),
        (Limits(9.0, 0.3, *pair.angle_limits.T), ("rate change",)),
        (Limits(9.0, 99.0, x[4:] - 0.01, x[4:] + 0.01), ("angle",)),
    ):
        weak = replace(tuning, input_weight=1.0)
        assert LinearMPC(weak, limits).solve(far, model, reference, np.zeros(2)).active == expected
