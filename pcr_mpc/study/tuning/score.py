"""What a tuning costs, and its score against another: less is better, and the other scores 1."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from ...control.tuning import Tuning
from ...errors import MarginsError
from ...loop.scene.scene import Scene
from ..episodes.episodes import Row, run_episode
from ..episodes.spread import EXACT, Spread
from ..margins.predicted import LONGEST, predict_delay_margin

# What each cost counts for, as a ratio to that of the start, and below which value it is not worth lowering: a camera
# does not see errors below 10 um; without mismatch the figure is the model's, and 2 um are wanted of it.
# A longer step is no harm as long as it fits the period, so it counts little, and nothing at all while it takes less
# than a tenth: there it would be the noise of the clock that decides between tunings, and no study would repeat.
_TERMS = {
    "tracking_mm": (5, 0.01),
    "nominal_mm": (2, 0.002),
    "effort_rad_s2": (1, 1e-3),
    "step_time": (1, 1e-3),
}
_FAST = 0.1
# A failed episode, or a control step that does not fit its period, as a share of all, and what is missing to a needed
# delay margin, as a share of it; no tracking makes up for them.
_PENALTY = 20.0
# A ratio is cut here: what is a hundred times as bad is bad enough, and infinite where there was no run at all.
_WORST_RATIO = 100.0


@dataclass(frozen=True)
class Costs:
    """Of a tuning in a scene.

    Attributes
    ----------
    tracking_mm : float
        RMS error, mean over the episodes with mismatch; infinite if one could not begin.
    nominal_mm : float
        RMS error without mismatch.
    effort_rad_s2 : float
        RMS change of the commanded rates, mean over the episodes.
    step_time_us : float
        Median CPU time of a control step without mismatch.
    step_time : float
        The same as a share of the period, at least a tenth, over that of the start, measured just before on the same
        core.
    failure_rate : float
        Share of the episodes that failed.
    late : float
        Share of the control steps without mismatch whose CPU time exceeds the period.
    delay_margin_ms : float
        Predicted further delay that the loop bears, where the scene needs one; else 0.
    margin_lack : float
        Share that is missing to what the scene needs of it.
    """

    tracking_mm: float
    nominal_mm: float
    effort_rad_s2: float
    step_time_us: float
    step_time: float
    failure_rate: float
    late: float
    delay_margin_ms: float = 0.0
    margin_lack: float = 0.0

    def row(self) -> dict[str, float]:
        """Plain columns."""
        return asdict(self)


def measure(scene: Scene, start: Tuning, tuning: Tuning, seeds: Sequence[int], spread: Spread) -> Costs:
    """Run a tuning once without mismatch and once for each seed with it."""
    beside = run_episode(scene, start, 0, EXACT)
    nominal = beside if tuning == start else run_episode(scene, tuning, 0, EXACT)
    rows = [run_episode(scene, tuning, seed, spread) for seed in seeds]
    mine, theirs = (
        max(_FAST, 1e-6 * _number(row["timing"]["control_cpu_us"]) / (one.period or scene.period))
        for row, one in ((nominal, tuning), (beside, start))
    )
    return Costs(
        tracking_mm=_mean(rows, "rms_mm"),
        nominal_mm=_number(nominal["rms_mm"]),
        effort_rad_s2=_mean(rows, "effort_rad_s2"),
        step_time_us=_number(nominal["timing"]["control_cpu_us"]),
        step_time=1.0 if mine == theirs else mine / theirs,
        failure_rate=sum(bool(row["failure"]) for row in [nominal, *rows]) / (1 + len(rows)),
        late=float(nominal["timing"]["late"] or 0.0),
        **_margin(scene, tuning),
    )


def _margin(scene: Scene, tuning: Tuning) -> dict[str, float]:
    """What is predicted of the delay margin, and missing to it, where the scene needs one."""
    if scene.delay_margin is None:
        return {}
    try:
        found = predict_delay_margin(scene, tuning).value
    except MarginsError:  # a reference without linear models on the way: nothing is known to be borne
        found = 0.0
    lack = max(0.0, 1.0 - found / scene.delay_margin)
    return {"delay_margin_ms": 1e3 * min(found, LONGEST * (tuning.period or scene.period)), "margin_lack": lack}


def score(costs: Costs, start: Costs) -> float:
    """Weighted mean of the costs over those of the start, with a penalty; exactly 1 for the start itself."""
    total = sum(weight for weight, _ in _TERMS.values())
    mean = sum(weight * _ratio(costs, start, name, floor) for name, (weight, floor) in _TERMS.items()) / total
    return (mean + _penalty(costs)) / (1.0 + _penalty(start))


def _ratio(costs: Costs, start: Costs, name: str, floor: float) -> float:
    mine, theirs = (max(float(getattr(one, name)), floor) for one in (costs, start))
    if mine == theirs:  # both may be infinite
        return 1.0
    return min(mine / theirs, _WORST_RATIO)


def _penalty(costs: Costs) -> float:
    return _PENALTY * (costs.failure_rate + costs.late + costs.margin_lack)


def _mean(rows: Sequence[Row], name: str) -> float:
    return sum(_number(row[name]) for row in rows) / len(rows)


def _number(value: Any) -> float:
    return math.inf if value is None else float(value)
