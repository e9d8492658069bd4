import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pcr_mpc.plant.rods.equations import propagation, sample_rod

START = np.array([0.3, -9.0, 4.0, 5.0])  # theta, n_x, n_y, m


def reference(length: float) -> np.ndarray:
    """The rod equation written once more, integrated by SciPy at 1e-13."""

    def slope(_, y):
        theta, m = y[2], y[3]
        return [np.cos(theta), np.sin(theta), m, START[1] * np.sin(theta) - START[2] * np.cos(theta), m * m / 2]

    y = solve_ivp(slope, (0, length), [0, 0, START[0], START[3], 0], "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    return np.array([y[0], y[1], y[2], START[1], START[2], y[3], y[4]])


@pytest.mark.parametrize(("scheme", "steps", "order"), [("rk4", (8, 16, 32), 4), ("rk8", (3, 6, 12), 8)])
def test_order_of_the_integrators(scheme, steps, order):
    exact = reference(1.0)
    errors = [np.abs(propagation(n, scheme)(START, 1.0).full().ravel() - exact).max() for n in steps]
    observed = np.log2(np.array(errors[:-1]) / errors[1:])
    assert observed[-1] == pytest.approx(order, abs=0.35)


def test_force_is_constant_and_invariant_is_kept():
    end = propagation(16, "rk8")(START, 1.0).full().ravel()
    theta, n_x, n_y, m = end[2:6]
    assert (n_x, n_y) == (START[1], START[2])
    before = START[3] ** 2 / 2 + START[1] * np.cos(START[0]) + START[2] * np.sin(START[0])
    assert m**2 / 2 + n_x * np.cos(theta) + n_y * np.sin(theta) == pytest.approx(before, abs=1e-10)


def test_samples_follow_the_rod():
    sampled = sample_rod(START[:, None], 11)
    assert sampled[:2, 0] == pytest.approx([0, 0])
    for s, column in zip(np.linspace(0, 1, 11)[1:], sampled.T[1:], strict=True):
        exact = reference(s)
        assert column == pytest.approx(exact[:6], abs=1e-8)
