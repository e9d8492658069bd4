"""A robot's numbers from logs of its motion: maximum a posteriori, by Gauss-Newton steps with exact derivatives."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from ...errors import IdentificationError
from ...loop.scene.scene import Scene
from ...plant.uncertainty import Uncertainty
from .balance import require_balance
from .information import Information, information
from .logs.checks import LONGEST_DELAY, checked_log, delay_in_angles
from .logs.log import Log
from .parameters import Parameters, catalogue, chosen, force_names
from .prediction import Predictor, physics
from .problem import Noise
from .residuals import change_noise, whiteness
from .result import Estimate, Fit, Identification
from .search import Found, held_fit, search

LOSSES = ("auto", "squares", "huber")
# Share of the tip's motion that may be left unexplained, and noise by which, before a log is another robot's.
_UNEXPLAINED, _TIMES_NOISE = 0.05, 10.0
_FAR = 4.0  # standard deviations from what was believed
_BAND = 1.959963984540054  # 95 % of a normal distribution


def identify(
    scene: Scene,
    logs: Sequence[Log],
    *,
    free: Sequence[str] = ("default",),
    fixed: Mapping[str, float] | None = None,
    uncertainty: Uncertainty | None = None,
    loss: str = "auto",
    validate: Sequence[Log] = (),
    progress: bool = False,
) -> Identification:
    """Find the numbers of a scene's robot that explain recorded motion.

    Parameters
    ----------
    scene : Scene
        Robot as it is believed; physics of the model; in which pose and how late its loop starts.
    logs : sequence of Log
        See `read_log`.
    free : sequence of str
        Which parameters are unknown, see `parameters.chosen`.
    fixed : mapping, optional
        Parameters that are known, by their names.
    uncertainty : Uncertainty, optional
        How well the robot's numbers are known; None: default priors.
    loss : {"auto", "squares", "huber"}
        Huber's bears outliers; "auto" takes it where there are some.
    validate : sequence of Log
        Logs that are only predicted.
    progress : bool
        Show each step on stderr.

    Raises
    ------
    LogError
        A log is not of this robot, in wrong units, or too short.
    IdentificationError
        No such parameter, no convergence, or the best numbers do not explain the log.
    PCRError
        The believed robot's rods cannot be where the log begins.
    """
    began = time.perf_counter()
    if loss not in LOSSES:
        raise IdentificationError(f"loss is {loss!r}, expected one of {', '.join(LOSSES)}")
    if not logs:
        raise IdentificationError("there is no log; record one with `pcr-mpc track`, or on the robot")
    pose = scene.start()
    logs = [checked_log(log, scene.robot, pose) for log in logs]
    others = [checked_log(log, scene.robot, pose) for log in validate]
    guess = _delay(scene, logs)
    longest = max(math.ceil(guess) + 1.0 if guess is not None else float(LONGEST_DELAY), float(scene.delay))
    everything = catalogue(scene.robot, len(logs), scene.delay if guess is None else guess, longest)
    parameters = chosen(
        scene.robot,
        everything,
        free=free,
        fixed=fixed,
        uncertainty=uncertainty,
        inertia=physics(scene).inertia != "none",
    )
    if parameters.index("delay") is None and "delay" not in (fixed or {}):
        parameters = replace(parameters, held=parameters.held | {"delay": float(scene.delay)})
    predictor = Predictor(scene, logs)
    require_balance(predictor, parameters.robot)
    with tqdm(desc="identify", unit="step", disable=not progress) as bar:

        def tell(half: float) -> None:
            bar.set_postfix_str(f"half chi^2 {half:.4g}")
            bar.update()

        found = search(predictor, parameters, loss, tell, try_delays=guess is None)
        fits = _fits(predictor, found, scene)
        _require_explained(fits, found, scene)
        # Below the least noise that is believed there is nothing but rounding to look at.
        coloured = whiteness(
            [channel for fit in fits if (fit.rms() or 0.0) > fit.noise.tip / 2.0 for channel in fit.tip.T]
        )
        widened = coloured.widening if not coloured.white else 1.0
        known = information(found.problem, found.jacobian, found.z, widened)
        validation = _validation(scene, others, parameters, found.z) if others else ()
    values = parameters.values(found.z)
    forces = tuple((values[x], values[y]) for x, y in (force_names(i, len(logs)) for i in range(len(logs))))
    estimates = _estimates(parameters, found, known, scene)
    return Identification(
        scene=scene,
        robot=parameters.robot_at(found.z),
        estimates=estimates,
        correlation=_correlation(parameters, found.z, known),
        delay=values["delay"],
        forces=forces,
        fits=fits,
        validation=validation,
        chi2_per_dof=_chi2(fits, found, scene),
        whiteness=coloured,
        unidentified=known.unidentified,
        correlations=known.correlations,
        warnings=tuple(_warnings(found, estimates, fits, coloured.white, widened)),
        method=found.method,
        loss="huber" if found.problem.robust else "squares",
        iterations=found.iterations,
        refused=found.refused,
        seconds=time.perf_counter() - began,
    )


def _delay(scene: Scene, logs: Sequence[Log]) -> float | None:
    """Delay of the commands that the angles tell [control periods]; None where they do not."""
    told = [(delay_in_angles(log), log.step) for log in logs if log.driven_by == "commands"]
    known = [delay * step / scene.period for delay, step in told if delay is not None]
    if known:
        return float(np.median(known))
    return None if told else 0.0


def _fits(predictor: Predictor, found: Found, scene: Scene) -> tuple[Fit, ...]:
    believed = found.problem.parameters
    values = believed.values(np.zeros(len(believed.free)))
    before = held_fit(predictor, found.problem.parameters, values | {"delay": float(scene.delay)}, found.problem.noise,
                      fine=False)  # fmt: skip
    readings, noise = found.readings, found.problem.noise
    fits = []
    for i, log in enumerate(predictor.logs):
        tip, angle = readings.tip[i] * noise[i].tip, readings.angle[i] * noise[i].angle
        outliers = int((np.abs(readings.tip[i]) > 6.0).sum() + (np.abs(readings.angle[i]) > 6.0).sum())
        fits.append(Fit(log, before.x[i] if before else None, readings.x[i], tip, angle, noise[i], outliers))
    return tuple(fits)


def _validation(scene: Scene, logs: Sequence[Log], parameters: Parameters, z: np.ndarray) -> tuple[Fit, ...]:
    """Predict logs that were not used, from the start that suits each best; the force is the mean of the others'."""
    predictor = Predictor(scene, logs)
    values = parameters.values(z)
    forces = {
        axis: float(np.mean([value for name, value in values.items() if name.endswith(f"force_{axis}")]))
        for axis in "xy"
    }
    others = {name: values[name] for name in values if "force_" not in name}
    own = {name: forces[name[-1]] for i in range(len(logs)) for name in force_names(i, len(logs))}
    believed = parameters.values(np.zeros(len(parameters.free)))
    old = {name: believed[name] for name in others} | dict.fromkeys(own, 0.0) | {"delay": float(scene.delay)}
    after = held_fit(predictor, parameters, others | own, None)
    before = held_fit(predictor, parameters, old, None)
    if after is None:
        raise IdentificationError(
            f"{logs[0].name}: with the numbers found, the rods cannot follow this log; is it the same robot's?"
        )
    fits = []
    for i, log in enumerate(predictor.logs):
        tip, angle = after.tip[i], after.angle[i]  # noise is 1 m and 1 rad there
        channels = list(tip.T)
        fits.append(
            Fit(log, before.x[i] if before else None, after.x[i], tip, angle, Noise(change_noise(channels), 0.0), 0)
        )
    return tuple(fits)


def _require_explained(fits: Sequence[Fit], found: Found, scene: Scene) -> None:
    for fit in fits:
        left, moved = fit.rms() or 0.0, float(np.sqrt(np.nansum(np.nanvar(fit.log.p, axis=0))))
        noise = change_noise(list(fit.tip.T))
        if found.problem.robust:  # outliers are no misfit
            left = 1.4826 * math.sqrt(2.0) * float(np.nanmedian(np.abs(fit.tip)))
            noise = fit.noise.tip
        if left > _UNEXPLAINED * moved and left > _TIMES_NOISE * noise:
            raise IdentificationError(
                f"{fit.log.name}: the best numbers leave {1e3 * left:.3g} mm RMS between prediction and log, where the "
                f"tip moves by {1e3 * moved:.3g} mm RMS: it is hardly a log of {scene.robot.name}; check geometry, "
                "units, signs and the start pose of the scene",
                residual=left,
            )


def _estimates(parameters: Parameters, found: Found, known: Information, scene: Scene) -> tuple[Estimate, ...]:
    believed = np.sqrt(np.diag(np.linalg.inv(parameters.root.T @ parameters.root)))
    values, gradient = parameters.values(found.z), parameters.gradient(found.z)
    sds = np.sqrt(np.diag(gradient @ known.covariance @ gradient.T))
    estimates = []
    for one, sd, before, slope in zip(parameters.free, sds.tolist(), believed.tolist(), np.diag(gradient), strict=True):
        value = values[one.name]
        far = math.exp(_BAND * sd / value) if one.positive else 0.0
        estimates.append(
            Estimate(
                name=one.name,
                unit=one.unit,
                value=value,
                sd=sd,
                low=value / far if far else value - _BAND * sd,
                high=value * far if far else value + _BAND * sd,
                prior=float(scene.delay) if one.name == "delay" else one.value,
                prior_sd=before * abs(one.slope(0.0)),
                told="data" if sd <= 0.5 * before * abs(slope) else "prior",
            )
        )
    return tuple(estimates)


def _correlation(parameters: Parameters, z: np.ndarray, known: Information) -> np.ndarray:
    gradient = parameters.gradient(z)
    covariance = gradient @ known.covariance @ gradient.T
    sd = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(sd, sd))


def _chi2(fits: Sequence[Fit], found: Found, scene: Scene) -> float:
    total, count = 0.0, 0
    for fit in fits:
        tip = max(change_noise(list(fit.tip.T)), 1e-12)
        angle = max(change_noise(list(fit.angle.T)), scene.angle_step / math.sqrt(12.0), 1e-12)
        if found.problem.robust:
            tip, angle = fit.noise.tip, fit.noise.angle
        for values, noise in ((fit.tip, tip), (fit.angle, angle)):
            scaled = values[~np.isnan(values)] / noise
            if found.problem.robust:
                scaled = scaled[np.abs(scaled) < 6.0]
            total += float(scaled @ scaled)
            count += len(scaled)
    return total / max(1, count - found.problem.size)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _warnings(
    found: Found, estimates: Sequence[Estimate], fits: Sequence[Fit], white: bool, widened: float
) -> list[str]:
    lines = []
    for one, z, each in zip(found.problem.parameters.free, found.z, estimates, strict=True):
        if abs(z) > _FAR and each.name != "delay":
            lines.append(
                f"{each.name} = {each.value:.4g} {each.unit} is {abs(z):.1f} standard deviations from the "
                f"{each.prior:.4g} that was believed; is it this robot's log?"
            )
        if each.name == "delay" and each.value > one.bounds[1] - 1e-6:
            lines.append(f"the delay is at its bound, {one.bounds[1]:g} periods")
    if not white:
        lines.append(
            f"residuals of the tip are not white: the model leaves something out, or noise is coloured; standard "
            f"deviations are widened by {math.sqrt(widened):.2g} for it, and may still be too small"
        )
    for i, fit in enumerate(fits):
        if fit.outliers:
            lines.append(f"{fit.log.name}: {fit.outliers} outliers, beyond six standard deviations")
        if fit.log.torque is not None:
            rest = found.readings.torque[i]
            lines.append(
                f"{fit.log.name}: motor torques tell the scale of forces; they are explained to "
                f"{_rms(rest):.2g} N m, of {_rms(fit.log.torque):.2g} N m RMS; friction and gears are not in the model"
            )
        if fit.log.driven_by == "angles":
            lines.append(f"{fit.log.name}: has no commands; the model is driven by the measured angles")
        if count := int(np.isnan(fit.log.u).sum()):
            lines.append(f"{fit.log.name}: {count} missing commands were estimated with the rest")
    return lines
