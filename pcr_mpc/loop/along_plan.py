"""Linear models along the last plan, renewed where the plan has moved: real-time iteration that pays as it goes."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from .. import interrupt
from ..frozen import Remade
from ..linearisation.linear_model import LinearModel
from ..linearisation.linearise import linearise
from ..plant.dynamics import Plant
from ..plant.equilibrium import Equilibrium

# A model is affine: about a point this far away [rod lengths], [rad] its force is off by the square of it.
_MOVED = 5e-4
_FORCE_CHANGED = 1.6e-5  # of sum EI/L^2: beyond it a model is moved to the new force


@dataclass
class _Spot:
    plant: Plant  # follows the rods from one point of linearisation to the next
    model: LinearModel | None = None


class AlongPlan(Remade):
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
        self._force_changed = _FORCE_CHANGED * plants[0].robot.force_scale if plants else 0.0
        self._at = np.full((len(plants), 2 + n), np.nan)  # where each model was made; NaN: there is none

    def reset(self, x: np.ndarray, pose: Equilibrium) -> None:
        """Forget the models; all rods are in ``pose``."""
        self._at[:] = np.nan
        for spot in self._spots:
            interrupt.check()
            spot.plant.reset(x, pose)
            spot.model = None

    def models(self, path: np.ndarray, u: np.ndarray, force: np.ndarray, payloads: np.ndarray) -> list[LinearModel]:
        """Models about the states of ``path``, shape (N - 1, 4 + n), under an external force; errors as `linearise`.

        ``payloads`` are what the tip carries there, shape (N - 1,) [kg].
        """
        if not self._spots:  # a horizon of one period has but the model at its start
            return []
        places = np.concatenate([path[:, :2], path[:, 4:]], axis=1)
        # So written that NaN is far.
        near = (np.abs(places - self._at) <= self._moved).all(axis=1).tolist()
        found = []
        for k, (spot, payload) in enumerate(zip(self._spots, payloads.tolist(), strict=True)):
            model = spot.model
            if payload != spot.plant.payload:
                spot.plant.carry(payload, path[k])
                model = None
            if model is None or not near[k]:
                self._at[k] = np.nan
                model = linearise(spot.plant, path[k], u, self._period, force)
                self._at[k] = places[k]
            elif max(map(abs, (force - model.force).tolist())) > self._force_changed:
                c = model.c + model.E @ (force - model.force)
                model = LinearModel(model.A, model.B, c, model.E, model.dt, force.copy())
            spot.model = model
            found.append(model)
        # The next place of the first spot is the new end of the horizon.
        self._spots.rotate(-1)
        self._at[:-1] = self._at[1:]
        self._at[-1] = np.nan
        return found
