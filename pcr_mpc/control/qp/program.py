"""The MPC problem as a QP in the inputs alone: min 1/2 U'PU + q'U subject to l <= A U <= u."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import scipy.sparse as sp

from ...buffered import BufferedFunction, per_thread
from ...errors import checked_array, checked_vector
from ...frozen import read_only
from ...linearisation.linear_model import LinearModel, LinearModels
from ..motor_limits import Limits
from ..tuning import Tuning
from .condensing import condensing


@dataclass(frozen=True, eq=False)
class Reference:
    """What to track over the horizon.

    Attributes
    ----------
    states : ndarray, shape (N, 4 + n)
        Wanted [p, v, q] at the end of each period.
    inputs : ndarray, shape (N, n)
        Feed-forward motor rates in each period [rad/s].
    forces : ndarray, shape (N, 2), optional
        That the rods carry at the end of each period [N]; the linear MPC has no use for them.
    """

    states: np.ndarray
    inputs: np.ndarray
    forces: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True, eq=False)
class QuadraticProgram:
    """QP data; U = [u_0, .., u_{N-1}].

    Attributes
    ----------
    P : ndarray, shape (Nn (Nn + 1) / 2,)
        Upper triangle of the Hessian, column by column.
    q : ndarray, shape (Nn,)
    A : scipy.sparse.csc_matrix, shape (3 N n, N n)
        Rows: rates, changes of rate, and sums of rates, which are the turned angles over dt: all in rad/s, and the
        same for every QP (see `constraint_matrix`).
    l, u : ndarray, shape (3 N n,)
        Bounds.
    sizes : ndarray, shape (3,), optional
        ``|P|``, ``|q|``, and 1 if all entries are finite and no bounds cross, as the graph that made them has found.
    free : ndarray, shape (Nn,), optional
        The optimum without limits; NaN where it is not known.
    block : ndarray, optional
        Linear models, state, P, q, l and u one after the other, where they are parts of one memory.
    """

    P: np.ndarray
    q: np.ndarray
    A: sp.csc_matrix
    l: np.ndarray  # noqa: E741  OSQP's name
    u: np.ndarray
    sizes: np.ndarray = field(default_factory=lambda: np.array([np.nan, np.nan, 0.0]))
    free: np.ndarray | None = None
    block: np.ndarray | None = None

    @property
    def sound(self) -> bool:
        """Whether the graph that made the data has found them finite, and no bounds to cross."""
        return bool(self.sizes[2] > 0.0)


def build_qp(
    x: np.ndarray,
    models: LinearModel | Sequence[LinearModel],
    reference: Reference,
    u_previous: np.ndarray,
    tuning: Tuning,
    limits: Limits,
    terminal_weight: np.ndarray,
) -> QuadraticProgram:
    """Assemble the QP of one control step.

    Minimises ``1/2 sum_k |x_k - xr_k|^2_Q + 1/2 |x_N - xr_N|^2_T + 1/2 sum_k |u_k - ur_k|^2_R`` over the affine
    model, with the states eliminated.

    Parameters
    ----------
    x : ndarray, shape (4 + n,)
        Current state.
    models : LinearModel or sequence of N
        One model for the whole horizon, or one for each period.
    reference : Reference
    u_previous : ndarray, shape (n,)
        Input of the last period, from which the change of rate counts [rad/s].
    tuning, limits : Tuning, Limits
        Horizon and weights; what the motors can do.
    terminal_weight : ndarray, shape (4 + n, 4 + n)
        T, for instance the cost-to-go of the LQR.
    """
    sequence = model_sequence(models, tuning.horizon)
    n, n_states = sequence.n, 4 + sequence.n
    x, u_previous = checked_vector("x", x, n_states), checked_vector("u_previous", u_previous, n)
    wanted = checked_array("reference.states", reference.states, (tuning.horizon, n_states))
    feed_forward = checked_array("reference.inputs", reference.inputs, (tuning.horizon, n))
    terminal_weight = checked_array("terminal_weight", terminal_weight, (n_states, n_states))
    if len(limits.angle_lower) != n:
        raise ValueError(f"limits are for {len(limits.angle_lower)} motors, the model has {n}")
    return assemble(x, sequence, Reference(wanted, feed_forward), u_previous, tuning, limits, terminal_weight)


def assemble(
    x: np.ndarray,
    models: LinearModels,
    reference: Reference,
    u_previous: np.ndarray,
    tuning: Tuning,
    limits: Limits,
    terminal_weight: np.ndarray,
) -> QuadraticProgram:
    """`build_qp` for arguments that are known to be right; one model or N of them."""
    n = models.n
    function = _buffered(tuning.horizon, n, len(models), tuning.velocity_weight > 0, tuning.angle_weight > 0)
    columns, start, states, inputs, previous, weights, terminal, bounds, dt = function.inputs
    columns.reshape(models.columns.shape, order="F")[:] = models.columns
    start[:] = x
    states.reshape((4 + n, -1), order="F")[:] = reference.states.T
    inputs.reshape((n, -1), order="F")[:] = reference.inputs.T
    previous[:] = u_previous
    weights[:] = stage_weights(tuning)
    terminal[:] = terminal_weight
    bounds[:] = motor_bounds(limits)
    dt[0] = models.dt
    function()
    p, q, lower, upper, free, sizes = (output.copy() for output in function.outputs)
    return QuadraticProgram(p, q, constraint_matrix(tuning.horizon, n), lower, upper, sizes, free)


@per_thread(maxsize=32)
def _buffered(horizon: int, n: int, models: int, velocity: bool, angle: bool) -> BufferedFunction:
    return BufferedFunction(condensing(horizon, n, models, velocity=velocity, angle=angle))


def stage_weights(tuning: Tuning) -> tuple[float, ...]:
    """Weights as `condensing` takes them."""
    return tuning.position_weight, tuning.velocity_weight, tuning.angle_weight, tuning.input_weight


def motor_bounds(limits: Limits) -> np.ndarray:
    """Limits as `condensing` takes them, shape (n, 4)."""
    ones = np.ones(len(limits.angle_lower))
    return np.stack([limits.rate * ones, limits.rate_change * ones, limits.angle_lower, limits.angle_upper], axis=1)


@lru_cache(maxsize=16)
def constraint_matrix(horizon: int, n: int) -> sp.csc_matrix:
    """Rows of the rates, of their changes, and of their sums (angles over dt), shape (3 N n, N n)."""
    each = sp.identity(n)
    rates = sp.identity(horizon * n)
    changes = sp.kron(sp.diags([1.0, -1.0], [0, -1], shape=(horizon, horizon)), each)
    angles = sp.kron(np.tril(np.ones((horizon, horizon))), each)
    matrix = sp.csc_matrix(sp.vstack([rates, changes, angles]))
    matrix.sort_indices()
    read_only(matrix.data)  # shared by all QPs of this size
    return matrix


def model_sequence(models: LinearModel | Sequence[LinearModel], horizon: int) -> LinearModels:
    """One model, or the models of all periods; ValueError if their number, shapes or periods are wrong."""
    if isinstance(models, LinearModels) and len(models) in (1, horizon):
        return models
    sequence: Sequence[LinearModel] = [models] if isinstance(models, LinearModel) else models
    if not isinstance(models, LinearModel) and len(sequence) != horizon:
        raise ValueError(f"models has {len(sequence)} entries, expected 1 or the horizon {horizon}")
    n = sequence[0].B.shape[-1]
    for model in sequence:
        shapes = model.A.shape, model.B.shape, model.c.shape
        if shapes != ((4 + n, 4 + n), (4 + n, n), (4 + n,)):
            raise ValueError(f"A, B, c of a model have shapes {shapes}, expected those of {n} motors")
    if any(model.dt != sequence[0].dt for model in sequence):
        raise ValueError("models have different periods dt")
    return LinearModels.of(sequence)
