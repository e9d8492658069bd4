"""What a controller does in a period, to first order about a pose: from measured states to rates."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...control.laws import LQR, PD, Law
from ...control.motor_limits import Limits
from ...control.mpc import LinearMPC, riccati
from ...control.qp.program import Reference, assemble
from ...control.tuning import Tuning
from ...linearisation.linear_model import LinearModel, LinearModels
from .linear_plant import Sampled


class Feedback(NamedTuple):
    """A control law without its limits: u = state x + shift s + force d + previous u_before.

    x is the state that is foreseen when the decision acts, s what is added to the angles of the reference, d the
    observed force; all are deviations from the reference.
    """

    state: np.ndarray
    shift: np.ndarray
    force: np.ndarray
    previous: np.ndarray


class Believed(NamedTuple):
    """What a controller takes the robot for about a pose.

    Attributes
    ----------
    model : LinearModel
        Over a control period.
    K : ndarray, shape (2, 2)
        Of the rods that the motor target is found with [N/m].
    G : ndarray, shape (2, n)
        Likewise [N/rad].
    gain : ndarray, shape (6, 2), or None
        Of the observer. None: there is none, the velocity is measured.
    delay : int
        Control periods that are predicted over.
    pull : float
        Share by which measured angles pull in a period those that are planned from; 1: these are the measured ones.
    age : float
        That a measured tip is known to have when it arrives, in periods.
    """

    model: LinearModel
    K: np.ndarray
    G: np.ndarray
    gain: np.ndarray | None
    delay: int
    pull: float = 1.0
    age: float = 0.0


def feedback_of(law: Law, believed: Believed, limits: Limits, resting: LinearModel) -> Feedback:
    """Feedback of a law about a pose; ``resting`` is the linear model about the start, for which laws are prepared."""
    model = believed.model
    n = model.B.shape[1]
    nothing = np.zeros((n, n))
    if isinstance(law, LinearMPC):
        return _mpc_feedback(model, law.tuning, limits, law.terminal)
    if isinstance(law, LQR):
        gain, _ = riccati(resting, law.tuning)
        return Feedback(-gain, gain[:, 4:], np.zeros((n, 2)), nothing)
    assert isinstance(law, PD)
    # The tip's wanted displacement, and the angles at which the rods hold it under the force.
    proportional, derivative = law.tuning.pd
    back = np.linalg.pinv(believed.G)
    wanted = -np.hstack([proportional * np.eye(2), derivative * np.eye(2), np.zeros((2, n))])
    state = -back @ believed.K @ wanted - np.eye(n, 4 + n, 4)
    return Feedback(state / model.dt, (np.eye(n) - back @ believed.G) / model.dt, back / model.dt, nothing)


def _mpc_feedback(model: LinearModel, tuning: Tuning, limits: Limits, terminal: np.ndarray) -> Feedback:
    """First inputs of the unconstrained solution -P^-1 q of the condensed QP, column by column."""
    n_states, n = model.B.shape
    horizon = tuning.horizon
    size = horizon * n
    # The triangle is the same for all right-hand sides: it is in the cost's second derivatives.
    upper = np.tril_indices(size)

    def solution(x: np.ndarray, shift: np.ndarray, force: np.ndarray, before: np.ndarray) -> np.ndarray:
        states = np.zeros((horizon, n_states))
        states[:, 4:] = shift
        disturbed = LinearModel(model.A, model.B, model.E @ force, model.E, model.dt, np.zeros(2))
        window = Reference(states, np.zeros((horizon, n)))
        qp = assemble(x, LinearModels.of([disturbed]), window, before, tuning, limits, terminal)
        hessian = np.zeros((size, size))
        hessian[upper] = qp.P  # the upper triangle column by column is the lower one row by row
        hessian += np.tril(hessian, -1).T
        return np.asarray(-np.linalg.solve(hessian, qp.q)[:n])

    sizes = (n_states, n, 2, n)
    ends = np.cumsum(sizes)[:-1]
    columns = [solution(*np.split(unit, ends)) for unit in np.eye(sum(sizes))]
    return Feedback(*np.split(np.stack(columns, axis=1), ends, axis=1))


def linear_controller(believed: Believed, feedback: Feedback, *, seen: bool = True) -> Sampled:
    """The controller as a linear system from measured states to rates, in a period in which the tip is seen, or not.

    Its state is [state expected at the measurement, observed force, commands that it knows to be on the way, the oldest
    first, last rates, angles to which the commands lead, estimates [p, v, force] back to the age of a picture, the
    oldest first]. The target of the motors is where the rods carry the observed force: at rest its Newton iteration has
    converged.
    """
    model, gain = believed.model, believed.gain
    n_states, n = model.B.shape
    kept = math.ceil(believed.age - 1e-9)
    sizes = [n_states, 2, *[n] * believed.delay, n, n, *[6] * kept, n_states]
    # Every quantity is a matrix by which it depends on [state, measurement].
    expected, force, *rest = np.split(np.eye(sum(sizes)), np.cumsum(sizes)[:-1])
    on_the_way, (before, led), past = rest[: believed.delay], rest[believed.delay : -1 - kept], rest[-1 - kept : -1]
    measured = rest[-1]
    if gain is None:
        estimate, force = measured if seen else np.vstack([expected[:4], measured[4:]]), 0.0 * force
    else:
        tip = expected[:4]
        if seen and past:
            moves = np.eye(6)
            moves[:4, :4], moves[:4, 4:] = model.A[:4, :4], model.E[:4]
            change = gain @ (measured[:2] - _tip_then([*past, tip], kept - believed.age, model.dt))
            for j in range(kept):
                past[j] = past[j] + change
                change = moves @ change
            tip, force = tip + change[:4], force + change[4:]
        if believed.pull < 1.0:  # the tip has moved with the angles as they are measured to have turned
            tip = tip + model.B[:4] @ (measured[4:] - expected[4:]) / model.dt
        if seen and not past:
            surprise = measured[:2] - tip[:2]
            tip, force = tip + gain[:4] @ surprise, force + gain[4:] @ surprise
        estimate = np.vstack([tip, measured[4:]])
    ahead = estimate
    for u in on_the_way:
        ahead = model.A @ ahead + model.B @ u + model.E @ force
    planned = ahead[4:] + (1.0 - believed.pull) * (led + model.dt * before - ahead[4:])
    ahead = np.vstack([ahead[:4], planned])
    shift = np.linalg.pinv(believed.G) @ force
    u = feedback.state @ ahead + feedback.shift @ shift + feedback.force @ force + feedback.previous @ before
    on_the_way = [*on_the_way, u]
    following = model.A @ estimate + model.B @ on_the_way[0] + model.E @ force
    past = [*past, np.vstack([estimate[:4], force])][1:] if kept else []
    state = np.vstack([following, force, *on_the_way[1:], u, planned, *past])
    (a, b), (c, d) = (np.split(each, [len(state)], axis=1) for each in (state, u))
    return Sampled(a, b, c, d)


def _tip_then(knots: list[np.ndarray], s: float, dt: float) -> np.ndarray:
    """Tip a fraction s of a period after the first of [p, v] at the ends of periods: Hermite's cubic."""
    start, end = knots[:2]
    return np.asarray(
        (1 + 2 * s) * (1 - s) ** 2 * start[:2] + s * (1 - s) ** 2 * dt * start[2:4]
        + s**2 * (3 - 2 * s) * end[:2] - s**2 * (1 - s) * dt * end[2:4]
    )  # fmt: skip
