"""Notices where a pose ends and the tip snaps to another, though each rod for itself keeps its shape."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...errors import PCRError
from ...plant.statics.balance import settle
from ...plant.statics.equilibrium import Equilibrium
from ...plant.statics.free_tip import free_solver
from .rig import Rig

# A tip that passes a fold of its own, and is not just swinging where no pose would be stable: its speed [m/s] and the
# force that it feels, in sum EI/L^2, are no greater.
_SLOW, _BALANCED = 0.6, 1.0
_PAUSE = 100  # periods in which the same fall is not told again


class Falls:
    """Watches the softest stiffness of a free tip from period to period."""

    def __init__(self) -> None:
        self._held: float | None = None  # potential energy where the tip was held last [J]
        self._pause = 0

    def look(self, rig: Rig) -> dict[str, Any] | None:
        """Look at a rig in a period, as `watch`."""
        load, speed = rig.plant.tip_weight + np.array(rig.scene.force), float(np.hypot(*rig.x[2:4]))
        try:
            return self.watch(rig.equilibrium(), speed, load, pulled=rig.pull is not None)
        except PCRError:  # between two branches, for a moment
            return None

    def watch(self, eq: Equilibrium, speed: float, load: np.ndarray, *, pulled: bool) -> dict[str, Any] | None:
        """Look at the rods in a period; return the event of a snap that begins, with what it loses downhill.

        Parameters
        ----------
        eq : Equilibrium
            Of the rods at the tip and the angles as they are.
        speed : float
            Of the tip [m/s].
        load : ndarray, shape (2,)
            On the tip, its weight and all that it carries included [N].
        pulled : bool
            Whether a spring holds the tip, which then falls nowhere.
        """
        self._pause = max(0, self._pause - 1)
        if pulled:
            self._held = None
        elif eq.stable:
            self._held = eq.energy - float(load @ eq.p)
        elif self._held is not None:
            before, self._held = self._held, None
            force = float(np.hypot(*(eq.force - load)))
            if not self._pause and speed <= _SLOW and force <= _BALANCED * eq.robot.force_scale:
                self._pause = _PAUSE
                return _told(eq, before, load)
        return None


def _told(eq: Equilibrium, before: float, load: np.ndarray) -> dict[str, Any]:
    solver = free_solver(eq.robot)
    said = "the pose has come to its fold: the tip snaps"
    found: dict[str, Any] = {"kind": "snap", "message": said, "p": eq.p.tolist()}
    try:
        solver.begin(eq)
        end = solver.equilibrium(settle(solver, eq.p, eq.q, load), eq.q)
    except PCRError:  # a rod snaps on the way down, and is told when it does
        return found
    lost = before - end.energy + float(load @ end.p)
    x, y = (1e3 * end.p).tolist()
    found["message"] += f"; downhill, at ({x:.0f}, {y:.0f}) mm, it has {1e3 * lost:.3g} mJ less"
    return found | {"energy": lost}
