"""Times of many calls of the same thing: wall and CPU, with the garbage collector on and off, the first ones apart."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from tqdm import tqdm

from ... import interrupt

# Calls that are reported apart and belong to no percentile: caches fill, branches are learnt, memory is mapped.
WARM_UP = 20
# The collector is on and off in turns, so that whatever else goes on on the machine meets both alike.
_BLOCK = 500
# A call that took so much longer by the wall clock than by the processor's was interrupted by others [s].
_INTERRUPTED = 50e-6
_PERCENTILES = {"p50": 50.0, "p95": 95.0, "p99": 99.0, "p99.9": 99.9}


@dataclass(frozen=True, eq=False)
class Times:
    """How long calls took, in order.

    Attributes
    ----------
    wall, cpu : ndarray, shape (n,)
        Of each call: elapsed, and spent by this thread [s].
    collecting : ndarray of bool, shape (n,)
        Whether Python's garbage collector was on.
    pauses : ndarray
        Its collections within these calls [s].
    """

    wall: np.ndarray
    cpu: np.ndarray
    collecting: np.ndarray
    pauses: np.ndarray

    @property
    def undisturbed(self) -> np.ndarray:
        """Which calls after the first ones nobody interrupted, shape (n - 20,)."""
        return np.asarray(self.wall - self.cpu <= _INTERRUPTED)[WARM_UP:]

    def record(self, name: str, method: str, budgets_hz: tuple[float, ...] = ()) -> dict[str, Any]:
        """Figures in us, ready for JSON."""
        wall, cpu, on = (array[WARM_UP:] for array in (self.wall, self.cpu, self.collecting))
        return {
            "name": name,
            "method": method,
            **distribution(wall),
            "cpu": distribution(cpu),
            "interrupted": int((~self.undisturbed).sum()),
            "first": (1e6 * self.wall[:WARM_UP]).tolist(),
            "collector_on": distribution(wall[on]),
            "collector_off": distribution(wall[~on]),
            "collections": {
                "n": len(self.pauses),
                "mean": 1e6 * float(self.pauses.mean()) if len(self.pauses) else None,
                "max": 1e6 * float(self.pauses.max()) if len(self.pauses) else None,
                "share": float(self.pauses.sum() / self.wall[self.collecting].sum()),
            },
            "misses": {f"{hz:g} Hz": {"wall": int((wall > 1 / hz).sum()), "cpu": int((cpu > 1 / hz).sum())}
                       for hz in budgets_hz},
        }  # fmt: skip


def distribution(seconds: np.ndarray) -> dict[str, Any]:
    """Percentiles, maximum, mean [us] and number; None where there is nothing to count."""
    us, names = 1e6 * seconds, [*_PERCENTILES, "max", "mean"]
    if not len(us):
        return {**dict.fromkeys(names), "n": 0}
    figures = [*np.percentile(us, list(_PERCENTILES.values())).tolist(), float(us.max()), float(us.mean())]
    return {**dict(zip(names, figures, strict=True)), "n": len(us)}


def measure(
    call: Callable[[int], Any], n: int, before: Callable[[int], Any] = lambda k: None, label: str | None = None
) -> Times:
    """Time ``call(k)`` for k from 0 to n - 1, each after ``before(k)``, which is not timed.

    ``label`` goes with a progress bar on stderr; None: there is none.
    """
    wall, cpu, collecting = np.empty(n), np.empty(n), np.zeros(n, dtype=bool)
    pauses: list[float] = []
    inside, began = False, 0.0

    def note(phase: str, info: dict[str, int]) -> None:
        nonlocal began
        if phase == "start":
            began = time.perf_counter()
        elif inside:
            pauses.append(time.perf_counter() - began)

    clock, processor = time.perf_counter, time.thread_time
    was_on = gc.isenabled()
    gc.callbacks.append(note)
    try:
        for k in tqdm(range(n), desc=label, unit="call", disable=label is None, miniters=_BLOCK):
            if k % _BLOCK == 0:
                gc.collect()
                (gc.disable if k // _BLOCK % 2 else gc.enable)()
            interrupt.check()
            before(k)
            inside = True
            spent, start = processor(), clock()
            call(k)
            wall[k] = clock() - start
            cpu[k] = processor() - spent
            inside = False
            collecting[k] = gc.isenabled()
    finally:
        gc.callbacks.remove(note)
        (gc.enable if was_on else gc.disable)()
    return Times(wall, cpu, collecting, np.array(pauses))
