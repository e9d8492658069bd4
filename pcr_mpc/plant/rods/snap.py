"""Where a rod lands when the shape it had is gone: descent of the elastic energy with the tip held."""

from __future__ import annotations

import numpy as np

from ...errors import ConvergenceError

_LINKS = 64
_LARGEST_TURN = 0.2  # of a link in one step of the descent [rad]
_MAX_STEPS = 2000
_FLAT = 1e-6  # slope along the constraint, relative to the joints' moments, at which the descent has arrived


def landing(nodes: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Stable shape to which a rod descends from a shape that is none at its pose.

    The rod becomes a chain of rigid links; the angles follow the downhill flow d theta/dt = -dU/d theta within the
    shapes whose tip is at the target, by implicit Euler steps. The time scale of the flow is no rod's (a real one
    swings before it comes to rest, and might settle elsewhere); where it goes is what "downhill" means.

    Parameters
    ----------
    nodes : ndarray, shape (4, N)
        States [theta, n_x, n_y, m] at s = j/N where the flow starts, normalised.
    pose : ndarray, shape (3,)
        Tip relative to base / L, clamp angle.

    Returns
    -------
    ndarray, shape (4, 8)
        States of the chain where it came to rest: a start for Newton's method, good to about 1e-3.

    Raises
    ------
    ConvergenceError
        The descent did not come to rest.
    """
    target, clamp, ds = pose[:2], pose[2], 1.0 / _LINKS
    # Springs in the joints; the first link's middle is half a link away from the clamp.
    bending = (2.0 * np.eye(_LINKS) - np.eye(_LINKS, k=1) - np.eye(_LINKS, k=-1)) / ds
    bending[0, 0], bending[-1, -1] = 3.0 / ds, 1.0 / ds
    at_rest = np.full(_LINKS, clamp)

    def gap(theta: np.ndarray) -> np.ndarray:
        return np.asarray(ds * np.array([np.cos(theta).sum(), np.sin(theta).sum()]) - target)

    def gradient(theta: np.ndarray) -> np.ndarray:
        return ds * np.stack([-np.sin(theta), np.cos(theta)])

    def closed(theta: np.ndarray) -> np.ndarray:
        for _ in range(20):
            if np.linalg.norm(gap(theta)) < 1e-12:
                break
            theta = theta - np.linalg.lstsq(gradient(theta), gap(theta), rcond=None)[0]
        return theta

    def energy(theta: np.ndarray) -> float:
        return float((theta - at_rest) @ bending @ (theta - at_rest)) / 2.0

    middles = (np.arange(_LINKS) + 0.5) * ds
    theta = closed(np.interp(middles, np.arange(nodes.shape[1]) / nodes.shape[1], nodes[0]))
    value, pace = energy(theta), 1e-3
    for _ in range(_MAX_STEPS):
        jacobian, slope = gradient(theta), bending @ (theta - at_rest)
        multiplier = -np.linalg.lstsq(jacobian.T, slope, rcond=None)[0]
        downhill = -(slope + jacobian.T @ multiplier)
        if np.abs(downhill).max() < _FLAT * (1.0 + np.abs(slope).max()):
            break
        curvature = bending - ds * np.diag(multiplier @ np.stack([np.cos(theta), np.sin(theta)]))
        system = np.block([[ds / pace * np.eye(_LINKS) + curvature, jacobian.T], [jacobian, np.zeros((2, 2))]])
        move = np.linalg.solve(system, np.append(downhill, [0.0, 0.0]))[:_LINKS]
        if np.abs(move).max() > _LARGEST_TURN:
            pace /= 2.0
            continue
        trial = closed(theta + move)
        if (lower := energy(trial)) < value:
            theta, value, pace = trial, lower, 1.5 * pace
        else:
            pace /= 2.0
    else:
        raise ConvergenceError(
            f"the rod did not come to rest in {_MAX_STEPS} steps downhill from a shape that is gone at {pose}; "
            f"steepest slope left {np.abs(downhill).max():.1e}",
            residual=float(np.abs(downhill).max()),
            iterations=_MAX_STEPS,
            last=theta,
        )
    at = np.arange(8) / 8.0
    moment = np.append(2.0 * (theta[0] - clamp), np.diff(theta)) / ds
    force = np.broadcast_to(-multiplier[:, None], (2, 8))
    return np.vstack(
        [np.append(clamp, np.interp(at[1:], middles, theta)), force, np.interp(at, np.arange(_LINKS) * ds, moment)]
    )
