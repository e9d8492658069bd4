"""An independent solution of the rod: Taylor series of the pendulum equation, in extended precision.

No elliptic functions and no CasADi: delta'' = sin(delta) from the tip, with its derivative in the tip angle, stepped by
power series of order 20 in numpy's longest float (64 bits of mantissa on x86), for many rods at once.
"""

import numpy as np

REAL = np.longdouble
ORDER, STEP = 20, 0.25  # the series converge within pi/2
LINEAR = REAL(1e-10)  # up to this angle delta = tip_angle cosh(u), to 1e-20


def solve(log_tip_angle, load, hand, pose):
    """Loads and their derivatives of rods with their tips held.

    Parameters
    ----------
    log_tip_angle, load, hand : ndarray, shape (m,)
        Of a nearby solution, improved by a Newton step.
    pose : ndarray, shape (3, m)
        Tip relative to base / L, clamp angle.

    Returns
    -------
    loads : ndarray, shape (3, m)
        [n_x, n_y, m] at the base.
    tangents : ndarray, shape (3, 3, m)
        d loads / d pose.
    change : ndarray, shape (m,)
        Of the unknowns in the Newton step: what is left is of the order of its square.
    """
    loads, tangents = np.empty((3, load.size), REAL), np.empty((3, 3, load.size), REAL)
    change = np.empty(load.size, REAL)
    # Rods of similar length from where their pendulum leaves the linear stretch take the same steps.
    order = np.argsort(load - _launch(log_tip_angle, load))
    for some in np.array_split(order, max(1, load.size // 400)):
        loads[:, some], tangents[:, :, some], change[some] = _solve(
            *(np.asarray(value, REAL) for value in (log_tip_angle[some], load[some], hand[some], pose[:, some]))
        )
    return loads, tangents, change


def _solve(log_tip_angle, load, hand, pose):
    x, y, angle = pose
    cos, sin = np.cos(angle), np.sin(angle)
    target = np.stack([cos * x + sin * y, hand * (cos * y - sin * x)])
    _, _, tip, by_l, by_load, _, _ = _rod(log_tip_angle, load)
    step = -_solve2(by_l, by_load, tip - target)
    log_tip_angle, load = log_tip_angle + step[0], load + step[1]
    delta, rate, _, by_l, by_load, delta_l, rate_l = _rod(log_tip_angle, load)
    psi = angle + hand * delta
    force = load**2 * np.stack([np.cos(psi), np.sin(psi)])
    across = np.stack([-force[1], force[0]])
    loads = np.vstack([force, hand * load * rate])
    loads_l = np.vstack([across * hand * delta_l, hand * load * rate_l])
    loads_load = np.vstack([2 * force / load + across * hand * rate, hand * (rate + load * np.sin(delta))])
    moves = np.stack([[cos, -hand * sin], [sin, hand * cos], [cos * y - sin * x, -hand * (cos * x + sin * y)]])
    tangents = np.empty((3, 3, load.size), REAL)
    for j, move in enumerate(moves):
        u = _solve2(by_l, by_load, move)
        tangents[:, j] = loads_l * u[0] + loads_load * u[1]
    tangents[:2, 2] += across
    return loads, tangents, np.abs(step).max(axis=0)


def _rod(log_tip_angle, load):
    """Delta and its rate at the base, tip seen from the clamp, their derivatives in the unknowns."""
    start = _launch(log_tip_angle, load)
    tip_angle = np.exp(log_tip_angle)
    delta, rate = tip_angle * np.cosh(start), tip_angle * np.sinh(start)
    state = [delta, rate, start, delta, rate, 0 * start]
    n_steps = int(np.ceil(float((load - start).max()) / STEP))
    for _ in range(n_steps):
        state = _step(state, (load - start) / n_steps)
    delta, rate, c, delta_l, rate_l, c_l = state
    cos, sin = np.cos(delta), np.sin(delta)
    # With C = int cos(delta) du and int sin(delta) du = rate the tip is R(delta) (C, -rate) / load.
    tip = np.stack([cos * c + sin * rate, sin * c - cos * rate]) / load
    across = np.stack([-tip[1], tip[0]])
    by_l = np.stack([cos * c_l + sin * rate_l, sin * c_l - cos * rate_l]) / load + across * delta_l
    by_load = across * rate + np.stack([1 / load, 0 * load]) - tip / load
    return delta, rate, tip, by_l, by_load, delta_l, rate_l


def _launch(log_tip_angle, load):
    return np.clip(np.log(2 * LINEAR) - log_tip_angle, 0, 0.9 * load).astype(REAL)


def _step(state, h):
    delta, rate, c, delta_l, rate_l, c_l, sin, cos = np.zeros((8, ORDER + 1, h.size), REAL)
    delta[0], rate[0], c[0], delta_l[0], rate_l[0], c_l[0] = state
    sin[0], cos[0] = np.sin(delta[0]), np.cos(delta[0])

    def product(a, b, k):
        return np.einsum("ij,ij->j", a[: k + 1], b[k::-1])

    for k in range(ORDER):
        n = REAL(k + 1)
        delta[k + 1], rate[k + 1], c[k + 1] = rate[k] / n, sin[k] / n, cos[k] / n
        delta_l[k + 1], rate_l[k + 1] = rate_l[k] / n, product(cos, delta_l, k) / n
        c_l[k + 1] = -product(sin, delta_l, k) / n
        sin[k + 1], cos[k + 1] = product(cos, rate, k) / n, -product(sin, rate, k) / n
    powers = h ** np.arange(ORDER + 1).astype(REAL)[:, None]
    return [np.einsum("ij,ij->j", series, powers) for series in (delta, rate, c, delta_l, rate_l, c_l)]


def _solve2(first, second, right):
    determinant = first[0] * second[1] - first[1] * second[0]
    return (
        np.stack([right[0] * second[1] - right[1] * second[0], first[0] * right[1] - first[1] * right[0]]) / determinant
    )
