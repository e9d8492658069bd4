"""What a search for a tuning found, as a table and as comments of its file."""

from __future__ import annotations

from ...study.tuning.space import Search
from ...study.tuning.study import Chosen
from ..tables import table


def tuning_table(search: Search, chosen: Chosen) -> str:
    """What a chosen tuning costs beside the one that the search started from."""
    rows = [(name, f"{mine:.3g}", f"{theirs:.3g}") for name, mine, theirs in _costs(chosen)]
    return (
        f"{table((f'{search.scene.name}, on other episodes', 'tuned', search.start.name), rows)}\n\n"
        f"score {chosen.confirmed:.3f} ({chosen.score:.3f} in the search; {search.start.name} has 1, less is better)"
    )


def tuning_comments(search: Search, chosen: Chosen, trials: int, commit: str) -> list[str]:
    """Where a tuning comes from, as lines of comment for its file."""
    start, seeds, others = search.start.name, search.seeds, search.other_seeds
    return [
        f'Tuned for the scene "{search.scene.name}" by pcr-mpc tune; it started from "{start}".',
        f"Trial {chosen.trial} of {trials}, each on {len(seeds)} episodes with mismatch, seeds {seeds[0]} to "
        f"{seeds[-1]}; code at {commit}.",
        f"Score {chosen.confirmed:.3f} on other episodes, seeds {others[0]} to {others[-1]} ({chosen.score:.3f} in the "
        f"search; {start} has 1, less is better). There:",
        *(f"  {name}: {mine:.3g}, {start} {theirs:.3g}" for name, mine, theirs in _costs(chosen)),
    ]


def _costs(chosen: Chosen) -> list[tuple[str, float, float]]:
    shown: tuple[tuple[str, str, float], ...] = (
        ("RMS under mismatch [mm]", "tracking_mm", 1.0),
        ("RMS without [mm]", "nominal_mm", 1.0),
        ("effort [rad/s^2]", "effort_rad_s2", 1.0),
        ("control step, CPU time [us]", "step_time_us", 1.0),
        ("failed episodes [%]", "failure_rate", 100.0),
    )
    if chosen.costs.delay_margin_ms:
        shown += (("predicted delay margin [ms]", "delay_margin_ms", 1.0),)
    return [
        (name, scale * getattr(chosen.costs, key), scale * getattr(chosen.start, key)) for name, key, scale in shown
    ]
