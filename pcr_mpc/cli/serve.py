"""The commands of the command line that close the loop over a wire."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

from .. import interrupt
from ..control.tuning import load_tuning
from ..errors import OutputError
from ..files import results, saved
from ..loop.scene.file import load_scene
from ..loop.scene.scene import Scene
from .places import own_place


def _scene(options: argparse.Namespace) -> Scene:
    scene = load_scene(options.scene)
    tuning = load_tuning(options.controller) if options.controller else scene.tuning
    period = getattr(options, "period", None)
    if tuning is not None and period is not None:
        tuning = replace(tuning, period=period)
    return scene if tuning is None else scene.tuned(tuning)


def serve(options: argparse.Namespace) -> int:
    """Run `pcr-mpc serve`."""
    from ..wire.decider import make_decider
    from ..wire.server import Server, require_address

    host, colon, port = options.listen.rpartition(":")
    if not (colon and port.isdigit()):
        raise ValueError(f"--listen is {options.listen!r}, expected HOST:PORT such as 127.0.0.1:5005")
    address = host or "127.0.0.1", int(port)
    require_address(address, anywhere=options.anywhere)  # before anything that takes long
    scene = _scene(options)
    decider = make_decider(scene, generated=options.generated)
    server = Server(decider, address, silence=options.silence, anywhere=options.anywhere)
    status = 0

    def tell(text: str) -> None:
        print(f"{scene.name}: {text}", file=sys.stderr, flush=True)

    try:
        tell(
            f"listening on {server.address[0]}:{server.address[1]}, for a measurement every {scene.period:g} s; "
            "Ctrl-C ends it"
        )
        server.serve(tell)
    except KeyboardInterrupt:  # the way out that `tell` names
        tell("ended")
        status = interrupt.exit_status()
    finally:
        server.close()
        if options.json:
            print(json.dumps({"scene": scene.name, "address": list(server.address), **server.counts}))
        else:
            tell(", ".join(f"{count} {name}" for name, count in server.counts.items()) or "no packet came")
    return status


def hil(options: argparse.Namespace) -> int:
    """Run `pcr-mpc hil`."""
    from ..report.hil import hil_table, plot_hil
    from ..wire.hil import run_hil

    scene = _scene(options)
    if options.duration is not None:
        scene = replace(scene, duration=options.duration)
    folder = options.out or own_place(options, f"hil/{scene.name}")
    found = run_hil(scene, generated=options.generated, progress=True)

    def write(where: Path) -> None:
        with results(where) as staged:
            (staged / "hil.json").write_text(json.dumps(found.summary(), indent=2) + "\n")
            plot_hil(found, staged / "hil.png")

    where, problem = saved(write, folder)
    summary = found.summary() | {"files": {name: str(where / name) for name in ("hil.json", "hil.png")}}
    print(json.dumps(summary) if options.json else f"\n{hil_table(summary)}\n\nwritten to {where}")
    if problem:
        raise OutputError(problem, path=str(folder))
    return 0
