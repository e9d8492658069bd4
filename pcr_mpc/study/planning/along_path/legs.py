"""Legs of a path with corners, planned one by one from rest to rest, as one motion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..timed_path import Move, TimedPath


@dataclass(frozen=True, eq=False)
class Legs(Move):
    """Motions from rest to rest, one after the other.

    Attributes
    ----------
    moves : tuple of Move
    """

    moves: tuple[Move, ...]

    @property
    def duration(self) -> float:
        """See `Move`."""
        return float(self.starts[-1])

    @cached_property
    def starts(self) -> np.ndarray:
        """When each begins, and the last one ends [s]."""
        return np.cumsum([0.0, *(move.duration for move in self.moves)])

    def at(self, t: np.ndarray) -> np.ndarray:
        """See `Move`."""
        which = np.clip(np.searchsorted(self.starts, t, side="right") - 1, 0, len(self.moves) - 1)
        samples = np.empty((len(t), 3, 2))
        for i, move in enumerate(self.moves):
            samples[which == i] = move.at(np.clip(t[which == i] - self.starts[i], 0.0, move.duration))
        return samples

    def breaks(self) -> np.ndarray:
        """See `Move`."""
        inner = [start + move.breaks()[:-1] for start, move in zip(self.starts, self.moves, strict=False)]
        return np.append(np.concatenate(inner), self.duration)


def joined(plans: Sequence[TimedPath]) -> TimedPath:
    """Plans of one scene, each of which begins where the one before it ends, as one plan."""
    if len(plans) == 1:
        return plans[0]
    move = Legs(tuple(planned.move for planned in plans))
    lengths = np.cumsum([0.0, *(planned.s[-1] for planned in plans)])
    return replace(
        plans[0],
        move=move,
        deviation=max(planned.deviation for planned in plans),
        grid=sum(planned.grid for planned in plans),
        t=np.concatenate([start + planned.t for start, planned in zip(move.starts, plans, strict=False)]),
        s=np.concatenate([start + planned.s for start, planned in zip(lengths, plans, strict=False)]),
        motion=np.concatenate([planned.motion for planned in plans]),
        q=np.concatenate([planned.q for planned in plans]),
        rates=np.concatenate([planned.rates for planned in plans]),
        shares=np.concatenate([planned.shares for planned in plans], axis=1),
        iterations=sum(planned.iterations for planned in plans),
    )
