"""A motion worth recording: a multi-sine from which a robot's numbers are told best."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from tqdm import tqdm

from ... import interrupt
from ...errors import IdentificationError, PCRError, checked_integer, checked_number
from ...frozen import Frozen
from ...loop.demand.feasibility import reference_of
from ...loop.demand.feed_forward import InverseDynamics, feed_forward
from ...loop.demand.slowing import Slowed
from ...loop.references.trajectory import Lemniscate, Trajectory, smooth_step
from ...loop.scene.scene import Scene
from ...plant.uncertainty import Uncertainty
from ..identification.information import information
from ..identification.logs.log import Log
from ..identification.parameters import catalogue, chosen
from ..identification.prediction import Piece, Predictor, physics
from ..identification.problem import Guess, Noise, Problem

# Sensors where the scene has none: a camera of 0.05 mm, encoders of 12 bits.
_TIP_NOISE, _ANGLE_STEP = 5e-5, 2.0 * math.pi / 4096
# Of motor limits, what a motion may use: a robot that is not as believed needs the rest.
_USED = 0.6
# Margins to folds are kept this many times.
_MARGIN = 1.5
# Largest excursion [rod lengths], and time in which the motion rises and dies away [s], or a share of the duration.
_FURTHEST, _RAMP, _RAMP_SHARE = 0.3, 0.6, 0.15
# Slowest sine: one in the time without ramps; fastest: this part of the tip's fastest swing.
_FASTEST = 0.6
_SINES = 6
_HALVINGS = 5
# Part of the trials that are drawn anew; the rest vary the best so far.
_DRAWN = 0.3


@dataclass(frozen=True, eq=False)
class MultiSine(Frozen):
    """Sines about a point, that rise from rest and die away.

    Attributes
    ----------
    centre : ndarray, shape (2,)
        [m].
    duration, ramp : float
        [s].
    omega : ndarray, shape (K,)
        [rad/s].
    sines, cosines : ndarray, shape (K, 2)
        Amplitudes [m].
    """

    centre: np.ndarray
    duration: float
    ramp: float
    omega: np.ndarray
    sines: np.ndarray
    cosines: np.ndarray

    def __call__(self, t: np.ndarray) -> np.ndarray:
        """See `Trajectory`."""
        t = np.asarray(t, dtype=float)
        rise, fall = smooth_step(t / self.ramp), smooth_step((self.duration - t) / self.ramp)
        # Window and its derivatives: the two ramps do not overlap.
        w = rise[0] * fall[0]
        dw = (rise[1] * fall[0] - rise[0] * fall[1]) / self.ramp
        ddw = (rise[2] * fall[0] + rise[0] * fall[2]) / self.ramp**2
        sin, cos = np.sin(np.outer(t, self.omega)), np.cos(np.outer(t, self.omega))
        s = sin @ self.sines + cos @ self.cosines
        ds = (cos * self.omega) @ self.sines - (sin * self.omega) @ self.cosines
        dds = -(sin * self.omega**2) @ self.sines - (cos * self.omega**2) @ self.cosines
        w, dw, ddw = w[:, None], dw[:, None], ddw[:, None]
        return np.stack([self.centre + w * s, dw * s + w * ds, ddw * s + 2.0 * dw * ds + w * dds], axis=1)

    def scaled(self, factor: float) -> MultiSine:
        """Return the same with other amplitudes."""
        return replace(self, sines=factor * self.sines, cosines=factor * self.cosines)


@dataclass(frozen=True, eq=False)
class Expected:
    """What a motion would tell.

    Attributes
    ----------
    name : str
    trajectory : Trajectory
    sd : dict
        Expected standard deviation of each number, in its unit.
    ratio : dict
        The same over what is believed of it.
    use : dict
        Share of each limit that it uses.
    """

    name: str
    trajectory: Trajectory
    sd: dict[str, float]
    ratio: dict[str, float]
    use: dict[str, float]

    @property
    def worst(self) -> float:
        """Largest ratio."""
        return max(self.ratio.values())


@dataclass(frozen=True, eq=False)
class Excitation:
    """A motion worth recording, beside the figure of eight.

    Attributes
    ----------
    scene : Scene
        With the duration.
    best, beside : Expected
    units : dict
        Of the numbers.
    noise : Noise
        That was taken for the sensors'.
    trials : int
    """

    scene: Scene
    best: Expected
    beside: Expected
    units: dict[str, str]
    noise: Noise
    trials: int


def excite(
    scene: Scene,
    duration: float,
    *,
    trials: int = 30,
    seed: int = 0,
    uncertainty: Uncertainty | None = None,
    progress: bool = False,
) -> Excitation:
    """Search for the multi-sine whose worst expected standard deviation is least (E-optimal in the numbers).

    Standard deviations are over what is believed; the tip is taken to be weighed, for motion does not tell the scale.
    Each candidate is as large as limits on rate, change of rate, torque, strain, tip region and distance to folds
    allow, with something to spare.

    Parameters
    ----------
    scene : Scene
        Robot, start pose, limits, period and sensors.
    duration : float
        [s].
    trials : int
        Candidates: three tenths drawn at random, the rest varied from the best.
    seed : int
        Of the candidates.
    uncertainty : Uncertainty, optional
        How well the robot's numbers are known; None: default priors.
    progress : bool
        Show each candidate on stderr.

    Raises
    ------
    ModelError
        The scene cannot have that duration.
    IdentificationError
        No candidate fits between the limits.
    """
    checked_number("duration", duration, minimum=1.0)
    trials = checked_integer("trials", trials)
    scene = replace(scene, duration=duration, tracking_error=scene.tracking_error)
    pose, rng = scene.start(), np.random.default_rng(seed)
    noise = Noise(scene.tip_noise or _TIP_NOISE, (scene.angle_step or _ANGLE_STEP) / math.sqrt(12.0))
    size = float(scene.robot.lengths.mean())
    # The ramp is a part of the scene's own reference; what else it is begins where the scene starts.
    own = scene.trajectory if isinstance(scene.trajectory, Lemniscate) else None
    eight = own or Lemniscate(tuple(pose.p.tolist()), (0.3 * size, 0.15 * size), 2.0, 1.0)
    beside = expected(scene, "lemniscate", eight, noise, uncertainty)
    if beside is None:
        raise IdentificationError(f"the rods of {scene.robot.name} cannot follow the figure of eight to compare with")
    draw = _drawer(scene, duration, pose.p, rng)
    best: Expected | None = None
    spread = 0.6
    with tqdm(range(trials), desc="excite", unit="motion", disable=not progress) as bar:
        for k in bar:
            interrupt.check()
            anew = best is None or k < _DRAWN * trials
            candidate = draw() if anew or best is None else _varied(best.trajectory, spread, rng)
            fitting = _as_large_as_fits(scene, candidate, size)
            found = fitting and expected(scene, "excited", fitting, noise, uncertainty)
            better = bool(found and (best is None or found.worst < best.worst))
            if found and better:
                best = found
                bar.set_postfix_str(f"worst sd {100 * found.worst:.3g} % of what is believed")
            if not anew:  # one fifth of the variations should be better
                spread = min(1.0, spread * 1.3) if better else max(0.05, spread * 0.94)
    if best is None:
        raise IdentificationError(
            f"none of {trials} motions about the start of {scene.name} fits between its limits; start from a pose with "
            "more room, or give more trials"
        )
    units = {one.name: one.unit for one in catalogue(scene.robot, 1, 0.0, 1.0)}
    return Excitation(scene, best, beside, units, noise, trials)


def expected(
    scene: Scene, name: str, trajectory: Trajectory, noise: Noise, uncertainty: Uncertainty | None = None
) -> Expected | None:
    """What recording a motion would tell of the believed robot's numbers; None where its rods cannot follow."""
    asked = replace(scene, trajectory=trajectory)
    try:
        reference = feed_forward(asked, scene.robot, scene.start(), 0)
        n = scene.n_periods
        log = Log(name, scene.period, scene.period * np.arange(n), reference.states[:n, :2], reference.states[:n, 4:],
                  reference.inputs[:n])  # fmt: skip
        predictor = Predictor(asked, [log])
        everything = catalogue(scene.robot, 1, float(scene.delay), scene.delay + 1.0)
        parameters = chosen(scene.robot, everything, fixed={"tip_mass": scene.robot.tip_mass}, uncertainty=uncertainty,
                            inertia=physics(scene).inertia != "none")  # fmt: skip
        first = scene.delay
        around = Guess(np.zeros(len(parameters.free)), (np.zeros(0),), reference.states[first : first + 1])
        problem = Problem(predictor, parameters, [Piece(0, first, n - 1, joined=False)], [noise], around)
        jacobian = problem.linearised(problem.packed(around))[1]
        known = information(problem, jacobian, around.z)
    except PCRError:
        return None
    gradient = parameters.gradient(around.z)
    sd = np.sqrt(np.diag(gradient @ known.covariance @ gradient.T))
    believed = np.sqrt(np.diag(gradient @ np.linalg.inv(parameters.root.T @ parameters.root) @ gradient.T))
    names = [one.name for one in parameters.free]
    return Expected(
        name, trajectory, dict(zip(names, sd.tolist(), strict=True)),
        dict(zip(names, (sd / believed).tolist(), strict=True)), _use(asked, reference),
    )  # fmt: skip


def _drawer(scene: Scene, duration: float, centre: np.ndarray, rng: np.random.Generator) -> Callable[[], MultiSine]:
    """Make a function that draws multi-sines: frequencies between the slowest and the fastest, random phases."""
    ramp = min(_RAMP, _RAMP_SHARE * duration)
    slowest = 2.0 * math.pi / (duration - 2.0 * ramp)
    probe = Log("probe", scene.period, np.zeros(1), np.zeros((1, 2)), np.zeros((1, scene.robot.n_rods)),
                np.zeros((1, scene.robot.n_rods)))  # fmt: skip
    fastest = max(_FASTEST * Predictor(scene, [probe]).omega, 2.0 * slowest)

    def draw() -> MultiSine:
        omega = np.sort(slowest * (fastest / slowest) ** rng.uniform(0.0, 1.0, _SINES))
        # Amplitudes that fall with the frequency: the rates of all sines are alike.
        amplitudes = rng.normal(size=(2, _SINES, 2)) / (1.0 + omega[:, None] / slowest)
        return MultiSine(centre, duration, ramp, omega, amplitudes[0], amplitudes[1])

    return draw


def _varied(trajectory: Trajectory, spread: float, rng: np.random.Generator) -> MultiSine:
    assert isinstance(trajectory, MultiSine)
    size = np.hypot(trajectory.sines, trajectory.cosines).mean()
    lightest = 1.0 / (1.0 + trajectory.omega / trajectory.omega[0])[:, None]
    change = spread * size * rng.normal(size=(2, *trajectory.sines.shape)) * lightest / lightest.mean()
    omega = trajectory.omega * np.exp(0.2 * spread * rng.normal(size=len(trajectory.omega)))
    return replace(trajectory, omega=omega, sines=trajectory.sines + change[0], cosines=trajectory.cosines + change[1])


def _as_large_as_fits(scene: Scene, candidate: MultiSine, size: float) -> MultiSine | None:
    """Scale a motion up to the limits; None where not even a small one fits."""
    t = scene.period * np.arange(scene.n_periods + 1)
    away = float(np.linalg.norm(candidate(t)[:, 0] - candidate.centre, axis=1).max())
    low, high = 0.0, _FURTHEST * size / away
    for _ in range(_HALVINGS):
        middle = (low + high) / 2.0 if low else high / 2.0
        low, high = (middle, high) if _fits(scene, candidate.scaled(middle)) else (low, middle)
    return candidate.scaled(low) if low else None


def _fits(scene: Scene, trajectory: MultiSine) -> bool:
    asked = replace(scene, trajectory=trajectory)
    try:
        reference = reference_of(asked, scene.start())
    except PCRError:
        return False
    return max(_use(asked, reference).values()) <= 1.0


def _use(scene: Scene, reference: InverseDynamics) -> dict[str, float]:
    """Share of each limit that a reference uses of what it may."""
    robot, poses = scene.robot, scene.pose_limits
    rates, changes, torques = Slowed.of(scene, robot, reference).motors(1.0)
    limits = (robot.rate_limit, robot.acceleration_limit, scene.torque_limit)
    # At rest a torque is what it is: what a motion adds is held against what is left.
    held = np.abs(torques[0])
    found = {
        "rate": float(np.abs(rates).max()) / (_USED * limits[0]),
        "change of rate": float(np.abs(changes).max()) / (_USED * limits[1]),
        "torque": float(((np.abs(torques) - held) / (_USED * np.maximum(limits[2] - held, 1e-12))).max()),
    }
    limited = np.isfinite(scene.strain_limits)
    if limited.any():
        strains, most = reference.strains[:, limited], scene.strain_limits[limited]
        left = np.maximum(most - strains[0], 1e-12 * most)
        found["strain"] = float(((strains - strains[0]) / (_USED * left)).max())
    stops, angles = robot.angle_limits, reference.states[:, 4:]
    room = np.minimum(angles[0] - stops[:, 0], stops[:, 1] - angles[0])
    found["stops"] = float((np.abs(angles - angles[0]).max(axis=0) / np.maximum(0.9 * room, 1e-12)).max())
    if poses.tip_lower is not None and poses.tip_upper is not None:
        middle = (np.array(poses.tip_lower) + poses.tip_upper) / 2.0
        half = (np.array(poses.tip_upper) - poses.tip_lower) / 2.0
        found["tip region"] = float((np.abs(reference.states[:, :2] - middle) / half).max())
    for name, values, least in (
        ("rod margin", reference.rod_margin, poses.rod_margin),
        ("stiffness", reference.stiffness, poses.stiffness),
    ):
        if least is not None and np.isfinite(values).any():
            found[name] = _MARGIN * least / max(float(np.nanmin(values)), 1e-300)
    return found
