"""The commands of the command line that show a robot in a browser."""

from __future__ import annotations

import argparse
import errno
import json
import os
import sys
import threading
import webbrowser

from .. import interrupt
from ..control.tuning import Tuning, load_tuning
from ..files import require_free
from ..loop.controller.own_controller import OwnController
from ..loop.run.run import load_run
from ..loop.scene.file import load_scene
from ..view.live.session import Session
from ..view.replay import write_replay
from ..view.server import ViewServer
from .places import own_place


def view(options: argparse.Namespace) -> int:
    """Run `pcr-mpc view`."""
    scene = load_scene(options.scene)
    own: Tuning | OwnController | None = None
    if isinstance(options.controller, str):
        own = OwnController(options.controller)
    elif options.controller:
        own = load_tuning(options.controller)
    folder = options.out or own_place(options, f"view/{scene.name}")
    server = ViewServer(
        lambda: Session(scene, own, options.seed), (options.host, options.port), folder, anywhere=options.anywhere
    )

    def tell(address: str) -> None:
        print(f"{scene.name}: {address}\n{scene.name}: whoever has this address moves the robot; Ctrl-C ends it",
              file=sys.stderr, flush=True)  # fmt: skip
        if not options.no_browser and _has_screen():
            # Aside: some browsers come back only when they are closed.
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()

    print(f"{scene.name}: getting ready", file=sys.stderr, flush=True)
    status = 0
    try:
        server.serve(tell)
    except KeyboardInterrupt:  # the way out that `tell` names
        print(f"{scene.name}: ended", file=sys.stderr)
        status = interrupt.exit_status()
    if options.json:
        print(json.dumps({"scene": scene.name, **server.counts}))
    return status


def _has_screen() -> bool:
    """Whether a browser would have one: those for terminals would take this one over."""
    return sys.platform in ("win32", "darwin") or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def replay(options: argparse.Namespace) -> int:
    """Run `pcr-mpc replay`."""
    if not options.record.exists():
        raise FileNotFoundError(errno.ENOENT, "", str(options.record))
    folder = options.record if options.record.is_dir() else options.record.parent
    out = options.out or folder / "replay.html"
    require_free(out, force=options.overwrite)
    run = load_run(folder)
    write_replay(run, out)
    said = {"scene": run.scene.name, "duration_s": float(run.t[-1]), "run_hash": run.hash(), "file": str(out)}
    print(json.dumps(said) if options.json else f"{run.scene.name}: {run.t[-1]:g} s in {out}; open it in any browser")
    return 0
