"""Where the motors and the tip of a wished robot go, with room for a path; and what to say where there is none."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from .. import interrupt
from ..errors import ConvergenceError, InfeasibleError, PCRError
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.free_tip import inverse_statics
from ..plant.statics.stability import least_rod_margin
from .layout import Layout, layouts
from .motors import MOTORS, Motor
from .wish import Wish, length_text, rounded

# What a path at rest may use of a limit, so that something is left for motion.
STRAIN_USED, TORQUE_USED = 0.9, 0.75
_LEAST_MARGIN = 0.2  # 1 - lambda / lambda_c of a rod
_LEAST_STIFFNESS = 3.0  # of K, in units of sum EI/L^3
_MOST_STRETCH = 0.97  # of a rod, beyond which small motions of the tip take large ones of the motor
_POINTS = 16  # of a path at which it is judged
_SIZES = (1.0, 0.8, 0.6, 0.4, 0.25, 0.15)  # of the largest path that are tried
_LARGE_ENOUGH = 0.8
_ATTEMPTS = 6  # at a diameter or a length that works
FARTHEST = 4.0  # change of a diameter or a length that is worth a word

Place = tuple[Layout, float, list[Equilibrium]]


def place(wish: Wish, strongest: Motor) -> tuple[Place | None, list[dict[str, float]]]:
    """Layout, share of its largest path, and poses at rest along it: the first that has room enough, or the roomiest.

    None where no path fits; and what is used of the limits at the centre of every layout that can be held.
    """
    best: Place | None = None
    found: list[dict[str, float]] = []
    for layout in layouts(wish.rods, wish.length, wish.spacing):
        interrupt.check()
        try:
            centre = inverse_statics(wish.robot(layout, strongest), layout.centre, mode=layout.mode)
        except ConvergenceError:
            continue
        used = used_at(centre, strongest)
        found.append(used)
        if max(used.values()) > 1.0:
            continue
        for share in _SIZES:
            if best is not None and share <= best[1]:
                break
            if (poses := _along(centre, layout, share, strongest)) is not None:
                best = layout, share, poses
        if best is not None and best[1] >= _LARGE_ENOUGH:
            break
    return best, found


def figure_of_eight(layout: Layout, share: float) -> np.ndarray:
    """Points of the path, from its centre on, shape (K, 2) [m]."""
    phase = 2 * math.pi * np.arange(_POINTS) / _POINTS
    return np.asarray(
        np.array(layout.centre)
        + share / 2 * np.stack([layout.size[0] * np.sin(phase), layout.size[1] * np.sin(2 * phase)], axis=1)
    )


def _along(centre: Equilibrium, layout: Layout, share: float, motor: Motor) -> list[Equilibrium] | None:
    poses = []
    eq = centre
    for p in figure_of_eight(layout, share):
        try:
            eq = inverse_statics(centre.robot, p, guess=eq)
        except PCRError:
            return None
        if max(used_at(eq, motor).values()) > 1.0:
            return None
        poses.append(eq)
    return poses


def used_at(eq: Equilibrium, motor: Motor) -> dict[str, float]:
    """How much of each limit a pose uses, 1 for all that a path at rest may use of it."""
    robot = eq.robot
    unit = float((robot.stiffnesses / robot.lengths**3).sum())
    return {
        "strain": float((eq.max_strain / robot.strain_limits).max()) / STRAIN_USED,
        "torque": float(np.abs(eq.motor_torque).max()) / motor.torque_limit / TORQUE_USED,
        "stretch": (1.0 - min(robot.slacks(eq.p))) / _MOST_STRETCH,
        "rod margin": (1.0 - least_rod_margin(eq)) / (1.0 - _LEAST_MARGIN),
        "stiffness": _LEAST_STIFFNESS * unit / float(eq.stiffness_eigenvalues[0]),
    }


def refusal(wish: Wish, found: list[dict[str, float]], strongest: Motor) -> InfeasibleError:
    """What is in the way, and the nearest thickness and length that would do: strain is as d/L, torque as d^4/L, or as
    t^3/L of a strip."""
    what = f"{wish.rods} rods of {wish.material}, {length_text(wish.length)} long and {length_text(wish.thick)} thick"
    if not found:
        apart = "" if wish.spacing is None else f" with motors {length_text(wish.spacing)} apart"
        widest = 1.3 if wish.rods == 2 else 1.8 * math.sin(math.pi / wish.rods)
        return InfeasibleError(
            f"{what}{apart} cannot be joined and hold their tip; put the motors {length_text(0.2 * wish.length)} to "
            f"{length_text(widest * wish.length)} apart, or leave --spacing out",
            limit="spacing",
        )

    def thinner(used: dict[str, float]) -> float:
        return max(used["strain"], math.pow(used["torque"], 1 / 4 if wish.across == "diameter" else 1 / 3), 1.0)

    # Of the places, the one that wants the least change of the thickness.
    least = min(found, key=thinner)
    lines, advice = [], _nearest(wish, strongest, thinner(least), max(least["strain"], least["torque"], 1.0))
    if least["strain"] > 1.0:
        limit = 100 * wish.stuff.strain_limit
        lines.append(
            f"they would be strained to {limit * STRAIN_USED * least['strain']:.2g} % at rest, where {wish.material} "
            f"bears {limit:.2g} % ({100 * STRAIN_USED:.0f} % of that are used here)"
        )
    if least["torque"] > 1.0:
        lines.append(
            f"they would take {TORQUE_USED * least['torque'] * strongest.torque_limit:.3g} N m of a motor at rest, "
            f"where {strongest.name} has {strongest.torque_limit:.3g} N m in motion ({100 * TORQUE_USED:.0f} % of "
            "that are used here)"
        )
        stronger = list(MOTORS)[list(MOTORS).index(strongest.name) + 1 :]
        advice += [f"a stronger motor, such as {name}" for name in stronger[:1]]
    what += f": {'; and '.join(lines) or 'no pose leaves room for a path'}"
    return InfeasibleError(
        f"{what}; nearest that works: {', or '.join(advice) or 'none of this kind; take another material'}",
        limit="strain" if least["strain"] > 1.0 else "torque" if least["torque"] > 1.0 else "room",
    )


def _nearest(wish: Wish, motor: Motor, thinner: float, longer: float) -> list[str]:
    """Thickness and length from which the rods work, each with the other as it is: tried, not guessed."""
    advice = []
    if wish.spacing is not None and place(replace(wish, spacing=None), motor)[0] is not None:
        advice.append("without --spacing")
    for key, first, step in ((wish.across, wish.thick / thinner, 0.97), ("length", wish.length * longer, 1.04)):
        if not 1 / FARTHEST <= first / getattr(wish, key) <= FARTHEST:
            continue
        for attempt in range(_ATTEMPTS):
            value = rounded(first * step ** (attempt + 1), up=step > 1, down=step < 1)
            other = replace(wish, **{key: value})  # type: ignore[arg-type]  # one of its lengths
            if place(other, motor)[0] is not None:
                advice.append(f"{length_text(value)} {key}")
                break
    return advice
