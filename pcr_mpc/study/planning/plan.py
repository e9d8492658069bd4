"""Plan the fastest motion along a scene's path that its robot can make."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from tqdm import tqdm

from ...errors import InfeasibleError, ModelError, PCRError, checked_number
from ...loop.references.on_curves import Spline
from ...loop.scene.scene import Scene
from .along_path.course import paced
from .along_path.fastest import faster
from .along_path.legs import joined
from .along_path.meshing import repaced
from .along_path.pace import spline_of, times
from .along_path.path import TipPath, paths_of
from .along_path.refining import ALLOWED, refined
from .along_path.starting import STATICS, evened, resting, started, where
from .along_path.timing import Problem, Timing
from .freely.free import Freed, freed, way_points
from .limits import PlanLimits, uses
from .motion import Carrier
from .rods_mass import asked_with_rods, with_rods
from .timed_path import Paced, RodsMass, TimedPath

_CELL = 1e-2  # s
_FEWEST, _MOST = 80, 240  # cells
_CELLS_PER_PIECE = 5
_ITERATIONS = (40, 12)
_GAINS = (1e-2, 1e-3)  # of the duration, that are none: roughly, and in the end


def plan_timing(
    scene: Scene,
    *,
    limits: PlanLimits | None = None,
    tolerance: float = 5e-5,
    cells: int | None = None,
    free: bool = False,
    progress: bool = False,
) -> TimedPath:
    """Time-optimal timing of the path of a scene's reference.

    The path is a spline of the tip, its timing that of the reference no more. Motor angles follow from inverse
    statics with the force that the motion takes, F = m (g - a) - c v: rates hold the path's third derivative in time,
    their change the fourth. The tip starts and ends at rest, with continuous acceleration and jerk; so
    it does in corners of the path, if the reference rests there too.

    Parameters
    ----------
    scene : Scene
        With a reference; of its timing nothing is kept.
    limits : PlanLimits, optional
        None: those of the scene.
    tolerance : float
        Greatest distance between the reference's path and the planned one [m].
    cells : int, optional
        Pieces of the timing, from rest to rest. None: of 10 ms each, at least 80 and at most 240.
    free : bool
        Whether the path between the reference's way-points is free too; it is found from the plan of the given one.
    progress : bool
        Show a bar on stderr.

    Returns
    -------
    TimedPath

    Raises
    ------
    ModelError
        The scene has no path to plan, or one with a corner in which the reference does not rest.
    UnreachableError, UnstableError, ConvergenceError
        The robot cannot rest at some point of the path; the message says where.
    InfeasibleError
        At rest on the path it would exceed a limit already; the message says which, where and by how much.

    Notes
    -----
    Where the scene's controller knows an inertia of the rods (``inertia`` in its tuning's model), limits are lowered
    until the motors keep the given ones with it (see `with_rods`); else the rods are without mass, as in the paper. A
    force on the tip that the scene has and its controller does not know is not planned for. With more motors than two
    the angles are those of least motion.

    References
    ----------
    .. [1] J. Bobrow, S. Dubowsky, J. Gibson, "Time-optimal control of robotic manipulators along specified paths",
       International Journal of Robotics Research 4 (1985).
    .. [2] D. Verscheure et al., "Time-optimal path tracking for robots: a convex optimization approach", IEEE
       Transactions on Automatic Control 54 (2009): b and its slope as unknowns.
    """
    if scene.trajectory is None:
        raise ModelError(f"{scene.name}: has no reference, and so no path to plan", key="reference")
    checked_number("tolerance", tolerance, above=0.0)
    limits = PlanLimits.of_scene(scene) if limits is None else limits
    span = _span(scene)
    paths = given = paths_of(scene.trajectory, span, tolerance)
    freely = (way_points(scene.trajectory), given) if free else None
    if freely is not None and len(given) > 1:  # a free path has no corners: it is found from a smooth one
        smooth = Spline(tuple(map(tuple, freely[0].tolist())), speed=1.0)
        paths = paths_of(smooth, smooth.duration, tolerance)
    carrier = carrier_of(scene, span)
    with tqdm(disable=not progress, unit=" iterations", desc="planning", leave=False) as bar:

        def told(seconds: float) -> None:
            bar.set_postfix_str(f"{seconds:.4f} s")
            bar.update()

        def planned_for(kept: PlanLimits) -> TimedPath:
            legs, pose = [], scene.start()
            for path in paths:
                _require_region(scene, kept, path)
                problem = Problem(paced(path), pose, carrier, kept)
                legs.append(_planned(scene.name, problem, path, cells, freely, told))
                if path is not paths[-1]:
                    pose = resting(problem, path)[-1]
            return joined(legs)

        return with_rods(scene, limits, carrier.mass - scene.robot.tip_mass, planned_for)


def rods_left_out(scene: Scene, planned: TimedPath) -> RodsMass:
    """What a plan asks of the motors where the rods have the mass that it leaves out.

    Raises
    ------
    PCRError
        With it the motors cannot follow at all.
    """
    assert scene.tuning is not None
    knowing = replace(scene, tuning=replace(scene.tuning, model=replace(scene.tuning.model, inertia="condensed")))
    carried = carrier_of(scene, _span(scene)).mass - scene.robot.tip_mass
    return asked_with_rods(knowing, planned, planned.limits, carried)


def _span(scene: Scene) -> float:
    """Time that the reference takes [s]."""
    own = getattr(scene.trajectory, "duration", math.inf)
    return own if math.isfinite(own) else scene.duration


def _planned(
    name: str,
    problem: Problem,
    path: TipPath,
    cells: int | None,
    freely: tuple[np.ndarray, list[TipPath]] | None,
    told: Callable[[float], None],
) -> TimedPath:
    """For rods without mass; freely between way-points, if these and the paths that were given are."""
    iterations = 0

    def counted(seconds: float) -> None:
        nonlocal iterations
        iterations += 1
        told(seconds)

    timing = faster(evened(started(problem, path)), most=_ITERATIONS[0], tolerance=_GAINS[0], told=counted)
    wanted = cells or int(np.clip(math.ceil(timing.duration / _CELL), _FEWEST, _MOST))
    timing = repaced(timing, wanted, max(8, wanted // _CELLS_PER_PIECE))
    timing = faster(timing, most=_ITERATIONS[1], allowed=ALLOWED, tolerance=_GAINS[1], told=counted)
    if freely is not None:
        found = freed(timing, freely[0], wanted, ALLOWED)
        return _free_result(name, found, freely[1], problem.limits, iterations + found.iterations)
    return _result(name, *refined(timing, counted), path.deviation, iterations)


def carrier_of(scene: Scene, span: float) -> Carrier:
    """What the tip is on its way, with the payload that it carries while it moves."""
    carried = np.zeros(1)
    if scene.payload is not None:
        assert scene.trajectory is not None
        t = np.linspace(0.0, span, 2001)
        moving = np.linalg.norm(scene.trajectory(t)[:, 1], axis=1) > 0.0
        carried = np.unique(scene.carried(t[moving]))
        if len(carried) != 1:
            raise ModelError(
                f"{scene.name}: the tip picks up or puts down {scene.payload.mass:g} kg while it moves, and when that "
                "is depends on the plan; plan the ways before and after it as scenes of their own",
                key="payload",
            )
    mass = scene.robot.tip_mass + float(carried[0])
    return Carrier(mass, scene.robot.drag, mass * np.array(scene.robot.gravity))


def _require_region(scene: Scene, limits: PlanLimits, path: TipPath) -> None:
    """Raise if the path leaves the scene's region, in whatever time."""
    s = np.linspace(0.0, path.length, 10 * STATICS + 1)
    p = path.derivatives(s)[0]
    if limits.tip_lower is not None and limits.tip_upper is not None:
        low, high = np.array(limits.tip_lower), np.array(limits.tip_upper)
        beyond = np.maximum(low - p, p - high).max(axis=1)
        at = int(beyond.argmax())
        if beyond[at] > 0.0:
            raise InfeasibleError(
                f"{where(s[at], p[at])} is {1e3 * beyond[at]:.3g} mm outside the tip's region, from {low} to {high} "
                "m; move the path, or widen the region",
                status="outside",
                limit="tip region",
                s=float(s[at]),
            )
    for length, at_point in zip(s, p, strict=True):
        try:
            scene.robot.require_reachable(at_point)
        except PCRError as error:
            raise type(error)(f"{where(length, at_point)}: {error}", **error.details, s=float(length)) from None


def _distance(paths: list[TipPath], tips: np.ndarray) -> float:
    """Largest distance of tips from a motion whose path is given [m]."""
    given = np.concatenate([path.derivatives(np.linspace(0.0, path.length, 2001))[0] for path in paths])
    away = max(float(np.linalg.norm(given - p, axis=1).min()) for p in tips)
    return away + max(path.deviation for path in paths)


def _result(name: str, timing: Timing, fine: Timing, deviation: float, iterations: int) -> TimedPath:
    moved, turned = fine.moved, fine.turned
    return TimedPath(
        name,
        Paced(timing.problem.course, spline_of(timing.pace.c)),
        timing.problem.limits,
        deviation,
        len(timing.x),
        t=times(fine.pace, fine.x),
        s=_lengths(moved.path[0]),
        motion=np.stack([moved.path[0], moved.velocity.value, moved.acceleration.value], axis=1),
        q=turned.q.value.copy(),
        rates=turned.rate.value.copy(),
        kinds=tuple(use.limit for use in fine.uses),
        shares=fine.shares,
        iterations=iterations,
    )


def _free_result(name: str, found: Freed, given: list[TipPath], limits: PlanLimits, iterations: int) -> TimedPath:
    asked = found.asked
    used = uses(limits, asked)
    return TimedPath(
        name,
        found.move,
        limits,
        _distance(given, asked.p),
        found.grid,
        t=found.t,
        s=_lengths(asked.p),
        motion=np.stack([asked.p, asked.velocity.value, asked.acceleration.value], axis=1),
        q=asked.q.value.copy(),
        rates=asked.rate.value.copy(),
        kinds=tuple(use.limit for use in used),
        shares=np.stack([use.largest for use in used]),
        iterations=iterations,
    )


def _lengths(tips: np.ndarray) -> np.ndarray:
    """From the start to each point [m]."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(tips, axis=0), axis=1))])
