import casadi as ca
import mpmath
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from pcr_mpc import solve_statics
from pcr_mpc.plant.rods.closed_form import elastica
from pcr_mpc.plant.rods.closed_form.chart import held_shapes
from pcr_mpc.plant.rods.closed_form.pendulum import swing_with_slopes
from pcr_mpc.plant.rods.equations import sample_rod
from tests.conftest import DATA


@pytest.fixture(scope="module")
def pendulum():
    log_tip_angle, u = ca.SX.sym("l"), ca.SX.sym("u")
    return ca.Function("pendulum", [log_tip_angle, u], list(elastica.pendulum(log_tip_angle, u)))


def by_mpmath(log_tip_angle, u):
    half, u = mpmath.exp(mpmath.mpf(log_tip_angle)) / 2, mpmath.mpf(u)
    k, k_prime = mpmath.cos(half), mpmath.sin(half)
    m = k * k
    sn, cn, dn = (mpmath.ellipfun(name, u, m=m) for name in ("sn", "cn", "dn"))
    quarter = int(mpmath.floor(u / mpmath.ellipk(m)))
    phi = mpmath.asin(sn)
    phi = {0: phi, 1: mpmath.pi - phi, 2: mpmath.pi - phi}.get(quarter, 2 * mpmath.pi + phi)
    delta = 2 * mpmath.atan2(k_prime / dn, k * cn / dn)
    return delta, 2 * k * k_prime * sn / dn, u - 2 * (mpmath.ellipe(phi, m) - m * sn * cn / dn)


@pytest.mark.parametrize(
    ("log_tip_angle", "u"),
    [(1.1, 0.3), (1.1, 5.9), (0.0, 2.0), (-2.0, 6.0), (-20.0, 15.0), (-20.0, 25.0), (-100.0, 98.0), (-250.0, 255.0)],
)
def test_pendulum_against_mpmath(pendulum, log_tip_angle, u):
    with mpmath.workdps(400):
        exact = [float(value) for value in by_mpmath(log_tip_angle, u)]
    found = [float(value) for value in pendulum(log_tip_angle, u)]
    found[0] = exact[0] + np.angle(np.exp(1j * (found[0] - exact[0])))
    assert found == pytest.approx(exact, abs=1e-14, rel=2e-13)


@pytest.mark.parametrize(
    ("log_tip_angle", "u"), [(1.14, 2.0), (1.1, 5.9), (0.0, 2.0), (-2.0, 0.1), (-20.0, 21.0), (-250.0, 249.0)]
)
def test_slopes_of_the_pendulum_against_mpmath(log_tip_angle, u):
    symbols = ca.SX.sym("l"), ca.SX.sym("u")
    found = ca.Function("slopes", symbols, [swing_with_slopes(*symbols)[1]])(log_tip_angle, u).full()
    with mpmath.workdps(400):
        step = mpmath.mpf(10) ** -150

        def slope(*by):
            ends = (by_mpmath(log_tip_angle + s * by[0], u + s * by[1]) for s in (step, -step))
            return [float((ahead - behind) / (2 * step)) for ahead, behind in zip(*ends, strict=True)]

        exact = np.array([slope(1, 0), slope(0, 1)]).T
    assert found == pytest.approx(exact, rel=2e-12, abs=1e-13 * np.abs(exact).max())


def test_pendulum_against_its_equation(pendulum):
    tip_angle, u = 0.4, 4.0
    sol = solve_ivp(
        lambda _, y: [y[1], np.sin(y[0]), np.cos(y[0])], (0, u), [tip_angle, 0, 0], "DOP853", rtol=1e-13, atol=1e-14
    )
    assert [float(v) for v in pendulum(np.log(tip_angle), u)] == pytest.approx(sol.y[:, -1], abs=1e-11)


def test_limit_of_stability_against_table():
    """The determinant of the tip map changes sign at the tabulated lambda_c(k)."""
    newton, _ = elastica.rod_newton()

    def unstable(load, log_tip_angle):
        return float(newton([log_tip_angle, load, 1.0], [0.5, 0.0, 0.0])[4][3])

    # The table's k are rounded values of the logistic function, which near 1 matter more than its lambda_c.
    logits = (-5, -2, -1, 0, 1, 2, 3, 4, 5, 7, 10)
    for logit, (k, limit) in zip(logits, np.loadtxt(DATA / "lambda_c.csv", delimiter=",", skiprows=2), strict=True):
        exact = 1 / (1 + np.exp(-logit))
        assert exact == pytest.approx(k, abs=5e-4)
        log_tip_angle = np.log(2 * np.arccos(exact))
        found = brentq(lambda x, at=log_tip_angle: unstable(x, at) - 0.5, limit - 0.1, limit + 0.1, xtol=1e-9)
        assert found == pytest.approx(limit, abs=1e-4 if limit < 10 else 1e-3)  # the decimals given


def test_mattiasson_1981_cantilever(pendulum):
    """Deflection, shortening and tip angle under a tip force perpendicular to the clamp tangent."""
    for load, w, shortening, theta_tip in np.genfromtxt(DATA / "mattiasson_1981.csv", delimiter=",", skip_header=3):
        root = np.sqrt(load)
        # The force is perpendicular to the tangent at the base where delta = pi/2.
        log_tip_angle = brentq(lambda x, root=root: float(pendulum(x, root)[0]) - np.pi / 2, -20.0, np.log(np.pi / 2))
        states = elastica.nodes(np.array([log_tip_angle, root, 1.0]), 0.0, 8)
        x, y, theta, n_x, n_y, m = sample_rod(states, 2)[:, -1]
        assert (y, 1 - x, theta) == pytest.approx((w, shortening, theta_tip), abs=2e-6)
        assert (n_x, n_y, m) == pytest.approx((0.0, load, 0.0), abs=1e-8)


@pytest.mark.parametrize(
    "unknowns",
    [[1.0, 2.0, 1], [-3.0, 6.0, -1], [-20.0, 21.0, 1], [-130.0, 132.3, 1], [-130.0, 131.5, -1], [-150, 140, 1]],
)
def test_unknowns_from_nodes(unknowns):
    """A start from nodes keeps the hand, also of a taut rod clamped against the pull (delta beyond pi)."""
    states = elastica.nodes(np.array(unknowns), 0.7, 8)
    assert elastica.from_nodes(states) == pytest.approx(unknowns, abs=0.05)


@pytest.mark.parametrize("move", [(0.0, -0.02), (0.02, -0.006), (-0.02, -0.006)])
def test_nearly_straight_rods_are_followed(pair, move):
    """Gently loaded rods swing from pulled to pushed within micrometres of the tip; here over 20 mm in one call."""
    start = solve_statics(pair, (0.0221, 0.3785), (1.453, 1.199))
    assert np.linalg.norm(start.rod_forces, axis=1).max() < 2.0
    once = solve_statics(pair, start.p + move, start.q, guess=start)
    stepwise = start
    for t in np.linspace(0, 1, 101)[1:]:
        stepwise = solve_statics(pair, start.p + t * np.array(move), start.q, guess=stepwise)
    assert once.force == pytest.approx(stepwise.force, rel=1e-9)


def test_chart_finds_the_shapes_it_is_made_of():
    rng = np.random.default_rng(3)
    for _ in range(50):
        r, angle = 0.95 * np.sqrt(rng.random()), rng.uniform(-np.pi, np.pi)
        xi, eta = r * np.cos(angle), r * np.sin(angle)
        shape = held_shapes(xi, eta)[0].polished(xi, eta)
        assert shape is not None
        assert sample_rod(shape.nodes(8, 0.0), 2)[:2, -1] == pytest.approx([xi, eta], abs=1e-5)
        assert sample_rod(shape.nodes(8, 0.0), 2)[5, -1] == pytest.approx(0.0, abs=1e-3)


def test_chart_is_symmetric():
    for xi, eta in ((0.5, 0.6), (-0.3, 0.2), (0.7, -0.5)):
        up, down = held_shapes(xi, eta)[0], held_shapes(xi, -eta)[0]
        assert (up.hand, up.load, up.energy) == pytest.approx((-down.hand, down.load, down.energy))


@pytest.mark.parametrize("hand", [1.0, -1.0])
def test_chord_leaves_the_third_power_of_an_error(hand):
    newton, residual = elastica.rod_newton()
    exact = np.array([np.log(0.7), 2.6, hand])
    pose = np.array([0.0, 0.0, 0.8])
    # The Newton step towards a target at the base, seen in the world, is minus the tip.
    step, tangent, *_ = newton(exact, pose)
    pose[:2] = -np.linalg.solve(tangent.full()[:2, :2], step.full().ravel()[:2])
    left = []
    for error in (2e-2, 1e-2):
        start = exact + error * np.array([1.0, -0.5, 0.0])
        step, tangent, *_ = newton(start, pose)
        second = start + step.full().ravel()
        third = second + elastica.rod_chord()(second, pose, tangent).full().ravel()
        left.append([float(residual(unknowns, pose)[0]) for unknowns in (start, second, third)])
    orders = np.log2(np.array(left[0]) / np.array(left[1]))
    assert orders == pytest.approx([1, 2, 3], abs=0.15)
