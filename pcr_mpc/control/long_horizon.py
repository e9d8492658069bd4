"""Condensing where a graph of the whole horizon would take minutes to build: the same QP by matrix products."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..linearisation.linear_model import LinearModel
from .tuning import Limits, Tuning


def condense(
    x: np.ndarray,
    models: Sequence[LinearModel],
    wanted: np.ndarray,
    feed_forward: np.ndarray,
    u_previous: np.ndarray,
    tuning: Tuning,
    limits: Limits,
    terminal_weight: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """P, q, l, u of the QP that `build_qp` describes, in O(N^2) and without a graph.

    With the responses G_k = dx_k/dU and w_k = Q_k G_k + A_k' w_{k+1}, the rows of the Hessian that belong to u_k are
    B_k' w_{k+1}: one sweep forwards, one backwards. The gradient is B_k' of the adjoint of the free response.

    Parameters
    ----------
    models : sequence of LinearModel
        One, or N.
    wanted, feed_forward : ndarray, shape (N, 4 + n), (N, n)
        Reference.
    """
    horizon, (n_states, n) = tuning.horizon, models[0].B.shape
    dt = models[0].dt
    motors = np.hstack([np.zeros((n, 4)), np.eye(n)])
    own = [
        (
            np.vstack([model.A[:4], motors]),
            np.vstack([model.B[:4], dt * np.eye(n)]),
            np.append(model.c[:4], np.zeros(n)),
        )
        for model in models
    ]
    steps = own * horizon if len(own) == 1 else own
    stage = np.repeat([tuning.position_weight, tuning.velocity_weight, tuning.angle_weight], [2, 2, n])

    free = np.empty((horizon + 1, n_states))
    responses = np.zeros((horizon + 1, n_states, horizon * n))
    free[0] = x
    for k, (a, b, c) in enumerate(steps):
        free[k + 1] = a @ free[k] + c
        np.matmul(a, responses[k], out=responses[k + 1])
        responses[k + 1, :, k * n : (k + 1) * n] = b
    hessian, gradient = np.empty((horizon * n, horizon * n)), np.empty((horizon, n))
    weighted = terminal_weight @ responses[horizon]
    adjoint = terminal_weight @ (free[horizon] - wanted[-1])
    for k in range(horizon - 1, -1, -1):
        a, b, _ = steps[k]
        hessian[k * n : (k + 1) * n] = b.T @ weighted
        gradient[k] = b.T @ adjoint
        if k:
            weighted = stage[:, None] * responses[k] + a.T @ weighted
            adjoint = stage * (free[k] - wanted[k - 1]) + a.T @ adjoint
    hessian[np.diag_indices_from(hessian)] += tuning.input_weight
    # The lower triangle row by row is the upper one column by column.
    triangle = hessian[np.tril_indices_from(hessian)]
    gradient -= tuning.input_weight * feed_forward

    first = np.append(u_previous, np.zeros(n * (horizon - 1)))
    low, high = ((stops - x[4:]) / dt for stops in (limits.angle_lower, limits.angle_upper))
    lower = np.concatenate([np.full(horizon * n, -limits.rate), first - limits.rate_change, np.tile(low, horizon)])
    upper = np.concatenate([np.full(horizon * n, limits.rate), first + limits.rate_change, np.tile(high, horizon)])
    return triangle, gradient.ravel(), lower, upper
