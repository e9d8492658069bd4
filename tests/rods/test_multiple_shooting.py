import casadi as ca
import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from pcr_mpc import load_robot, solve_statics
from pcr_mpc.plant.rods.closed_form import elastica
from pcr_mpc.plant.rods.equations import Layout, propagation, sample_rod
from pcr_mpc.plant.rods.shooting.multiple_shooting import robot_residual, rod_newton
from tests.conftest import DATA, MODELS


def unknowns(eq):
    """Y of the paper, in physical units, from an equilibrium."""
    blocks = []
    for rod, nodes in zip(eq.robot.rods, eq.nodes, strict=True):
        ei, length = rod.bending_stiffness, rod.length
        physical = nodes * np.array([1, ei / length**2, ei / length**2, ei / length])[:, None]
        blocks.append(physical.ravel(order="F")[1:])  # theta_0 = q is prescribed
    return np.concatenate([*blocks, eq.force])


@pytest.mark.parametrize("segments", [1, 2, 8])
def test_counts_close(pair, segments):
    residual = robot_residual(pair, segments)
    assert residual.size1_in(0) == residual.size1_out(0) == 8 * segments


def test_counts_close_for_three_rods():
    robot = load_robot(MODELS / "three_rods.toml")
    residual = robot_residual(robot, 4)
    assert residual.size1_in(0) == residual.size1_out(0) == 3 * 15 + 2


def test_solution_is_a_root_of_the_papers_residual(pair, poses):
    residual = robot_residual(pair, 8, 1)
    for pose in poses:
        eq = solve_statics(pair, pose.p, pose.q, method="multiple_shooting", steps=1, guess=pose)
        assert np.abs(residual(unknowns(eq), eq.p, eq.q).full()).max() < 1e-8


def test_derivatives_against_one_factorisation_of_the_papers_residual(pair, poses):
    """K, G and the torques by the implicit function theorem on eq. (15), beside those of the sweep."""
    residual = robot_residual(pair, 8, 1)
    y, p, q = (ca.SX.sym(name, residual.size1_in(i)) for i, name in enumerate("Ypq"))
    r = residual(y, p, q)
    jacobians = ca.Function("jacobians", [y, p, q], [ca.jacobian(r, y), ca.jacobian(r, ca.vertcat(p, q))])
    for pose in poses:
        eq = solve_statics(pair, pose.p, pose.q, method="multiple_shooting", steps=1, guess=pose)
        by_y, by_pose = jacobians(unknowns(eq), eq.p, eq.q)
        lu = splu(sp.csc_matrix(by_y.full()))
        sensitivity = -lu.solve(by_pose.full())
        scale = np.abs(eq.dforce_dp).max()
        assert sensitivity[-2:, :2] == pytest.approx(eq.dforce_dp, abs=1e-9 * scale)
        assert sensitivity[-2:, 2:] == pytest.approx(eq.dforce_dq, abs=1e-9 * scale)
        # n_x, n_y, m of node 0 come first in each rod's block: the base moment is entry 2.
        assert -sensitivity[2, 2] == pytest.approx(eq.dtorque_dq[0], rel=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_step_is_the_newton_step(seed):
    """The sweep against a dense solve, at points that are no solutions, taut ones included."""
    rng = np.random.default_rng(seed)
    n, steps = 6, 3
    newton, _ = rod_newton(n, steps, "rk8")
    nodes, pose = ca.SX.sym("nodes", 4 * n), ca.SX.sym("pose", 3)
    z = [ca.vertcat(pose[2], nodes[1:4]), *(nodes[4 * j : 4 * j + 4] for j in range(1, n))]
    ends = [propagation(steps, "rk8")(node, 1 / n) for node in z]
    rows = [ends[j][2:6] - z[j + 1] for j in range(n - 1)]
    r = ca.vertcat(*rows, sum(end[:2] for end in ends) - pose[:2], ends[-1][5])
    dense = ca.Function("dense", [nodes, pose], [r, ca.jacobian(r, nodes)[:, 1:], ca.jacobian(r, pose)])
    point = rng.normal(size=4 * n)
    point[1::4] += 10 ** rng.uniform(0, 2.5)
    at = rng.normal(size=3)
    point[0] = at[2]
    value, by_nodes, by_pose = (m.full() for m in dense(point, at))
    step, tangent = (m.full() for m in newton(point, at)[:2])
    assert step[1:] == pytest.approx(-np.linalg.solve(by_nodes, value), rel=1e-8, abs=1e-8 * np.abs(step).max())
    assert tangent[1:] == pytest.approx(-np.linalg.solve(by_nodes, by_pose), rel=1e-8, abs=1e-8 * np.abs(tangent).max())
    assert tangent[0] == pytest.approx([0, 0, 1])


def test_force_converges_with_the_order_of_the_integrator(pair, centre):
    p, q = centre.p + [0.02, -0.03], centre.q
    options = {"method": "multiple_shooting", "steps": 1, "scheme": "rk4", "guess": centre}
    exact = solve_statics(pair, p, q, guess=centre).force
    errors = [np.linalg.norm(solve_statics(pair, p, q, segments=n, **options).force - exact) for n in (16, 32, 64)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(4, abs=0.3)
    assert np.log2(errors[1] / errors[2]) == pytest.approx(4, abs=0.3)


def test_default_discretisation_meets_1e_5(pair, poses):
    for pose in poses:
        eq = solve_statics(pair, pose.p, pose.q, method="multiple_shooting", segments=8, steps=1, guess=pose)
        assert np.linalg.norm(eq.force - pose.force) < 1e-5 * np.linalg.norm(pose.rod_forces)


def test_conjugate_points_find_the_tabulated_limit():
    """The sweep's verdict on shapes of the closed form, 1 % on either side of lambda_c(k)."""
    newton, _ = rod_newton(8, 6, "rk8")
    for k, limit in np.loadtxt(DATA / "lambda_c.csv", delimiter=",", skiprows=2):
        for factor, expected in ((0.99, 0), (1.01, 1)):
            nodes = elastica.nodes(np.array([np.log(2 * np.arccos(k)), factor * limit, 1.0]), 0.0, 8)
            tip = sample_rod(nodes, 2)[:2, -1]
            *_, scalars = newton(nodes.ravel(order="F"), [*tip, 0.0])
            assert float(scalars[0]) < 1e-6
            assert float(scalars[3]) == expected, (k, factor)


@pytest.mark.parametrize(
    "layout", [None, Layout(0, varying=False, stretching=False), Layout(2, varying=True, stretching=True)]
)
def test_calls_for_a_compiler_give_the_same_bits(layout):
    """Five segments, whose length is no floating-point number."""
    inlined, called = (rod_newton(5, 2, "rk8", layout, inline=inline) for inline in (True, False))
    rng = np.random.default_rng(3)
    for _ in range(20):
        rod = [rng.normal(0.0, 2.0, 20), rng.normal(0.0, 0.5, 3)]
        if layout:
            rod.append(rng.uniform(0.5, 1.0, layout.size))
        for one, other in zip(inlined, called, strict=True):
            for a, b in zip(one(*rod), other(*rod), strict=True):
                np.testing.assert_array_equal(a.full(), b.full())
