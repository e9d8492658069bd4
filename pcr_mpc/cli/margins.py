"""The command of the command line that tells how far a loop is from instability."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from ..control.tuning import load_tuning
from ..errors import OutputError
from ..files import require_folder, results, saved
from ..loop.scene.file import load_scene
from ..report.studies.margins import margins_table, plot_margins
from ..study.margins.side_by_side import compare_margins
from .places import own_place


def margins(options: argparse.Namespace) -> int:
    """Run `pcr-mpc margins`."""
    scene = load_scene(options.scene)
    tuning = load_tuning(options.controller) if options.controller else None
    used = tuning or scene.tuning
    out = options.out or own_place(options, f"margins/{scene.name}_{used.name if used else 'none'}")
    names = ["margins.json"] if options.no_pictures else ["margins.json", "margins.png"]
    require_folder(out, names, force=options.overwrite)
    predicted, summary = compare_margins(
        scene, tuning, poses=options.poses, measure=not options.predicted, progress=True
    )

    def write(folder: Path) -> None:
        with results(folder) as staged:
            if not options.no_pictures:
                plot_margins(predicted, summary, staged / "margins.png")
            summary["files"] = {name: str(folder / name) for name in names}
            (staged / "margins.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")

    folder, problem = saved(write, out)
    print(json.dumps(summary) if options.json else f"\n{margins_table(summary)}\n\nwritten to {folder}")
    if problem:
        raise OutputError(problem, path=str(folder))
    return 0
