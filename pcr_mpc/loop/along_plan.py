"""Linear models along the last plan, renewed where the plan has moved: real-time iteration that pays as it goes."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from ..linearisation.linear_model import LinearModel
from ..linearisation.linearise import linearise
from ..plant.dynamics import Plant
from ..plant.equilibrium import Equilibrium

# A model is affine: about a point this far away [rod lengths], [rad] its force is off by the square of it.
_MOVED = 5e-4
_FORCE_CHANGED = 1e-5  # N


@dataclass
class _Spot:
    plant: Plant  # follows the rods from one point of linearisation to the next
    at: np.ndarray | None = None
    model: LinearModel | None = None


class AlongPlan:
    """One model for each period of the plan but the first.

    In the next control period a spot is needed where its neighbour is now, so the models move on with time, and are
    made anew only at the end of the horizon and where the plan has changed.

    Parameters
    ----------
    plants : list of Plant, length N - 1
    period : float
        Of the models [s].
    """

    def __init__(self, plants: list[Plant], period: float) -> None:
        self._spots = deque(_Spot(plant) for plant in plants)
        self._period = period
        length = float(plants[0].robot.lengths.mean()) if plants else 1.0
        n = plants[0].robot.n_rods if plants else 0
        self._moved = _MOVED * np.array([length] * 2 + [1.0] * n)

    def reset(self, x: np.ndarray, pose: Equilibrium) -> None:
        """Forget the models; all rods are in ``pose``."""
        for spot in self._spots:
            spot.plant.reset(x, pose)
            spot.at = spot.model = None

    def models(self, path: np.ndarray, u: np.ndarray, force: np.ndarray, payloads: np.ndarray) -> list[LinearModel]:
        """Models about the states of ``path``, shape (N - 1, 4 + n), under an external force; errors as `linearise`.

        ``payloads`` are what the tip carries there, shape (N - 1,) [kg].
        """
        found = []
        for spot, x, payload in zip(self._spots, path, payloads.tolist(), strict=True):
            if payload != spot.plant.payload:
                spot.plant.carry(payload, x)
                spot.at = None
            at = np.concatenate([x[:2], x[4:]])
            if spot.model is None or spot.at is None or (np.abs(at - spot.at) > self._moved).any():
                spot.at, spot.model = at, linearise(spot.plant, x, u, self._period, force)
            elif max(map(abs, (force - spot.model.force).tolist())) > _FORCE_CHANGED:
                c = spot.model.c + spot.model.E @ (force - spot.model.force)
                spot.model = replace(spot.model, c=c, force=force.copy())
            found.append(spot.model)
        if self._spots:
            self._spots.rotate(-1)
            self._spots[-1].at = self._spots[-1].model = None  # its next place is the new end of the horizon
        return found
