"""Commands that run a scene's loop."""

from __future__ import annotations

from pathlib import Path

from ...methods import METHODS
from .command import Command, tuning_or_class


def add(command: Command) -> None:
    """Add them."""
    track = command(
        "track", "track", "track", "Run a scene in closed loop; write its record, a picture and an animation."
    )
    track.add_argument("scene", help="scene: a file, or a name such as lemniscate of pcr-mpc models")
    track.add_argument("--controller", type=tuning_or_class, metavar="FILE|NAME|MODULE:CLASS",
                       help="tuning instead of the scene's own: a file, or a name of pcr-mpc models; or a controller "
                       "of your own, such as mine:Mine for class Mine in mine.py")  # fmt: skip
    track.add_argument("--method", choices=METHODS, help="statics of the plant instead of the scene's own")
    track.add_argument("--plant", choices=("mujoco",), help="simulate the robot with MuJoCo instead (extra 'mujoco')")
    track.add_argument("--links", type=int, help="of each rod, with --plant mujoco (default 40)")
    track.add_argument("--seed", type=int, default=0, help="of the measurement noise (default 0)")
    track.add_argument("--out", type=Path, help="folder for the results (default results/NAME)")
    track.add_argument(
        "--no-pictures", action="store_true", help="write the record only, neither pictures nor replay.html"
    )

    timing = command(
        "timing",
        "study",
        "time_loop",
        "Time plant steps of every method and the control step against their budgets; draw it.",
    )
    timing.add_argument("scene", help="scene: a file, or a name of pcr-mpc models")
    timing.add_argument("--steps", type=int,
                        help="plant steps and control steps (default 100000: two or three minutes); whatever the "
                        "number, C is compiled besides: a minute")  # fmt: skip
    timing.add_argument("--no-c", action="store_true", help="leave out the steps in C, which must be compiled")
    timing.add_argument("--quick", action="store_true",
                        help="a first look: 2000 steps and no C, in a few seconds")  # fmt: skip
    timing.add_argument("--out", type=Path, help="folder for the results (default results/timing/NAME)")

    margins = command(
        "margins",
        "margins",
        "margins",
        "Tell how far a scene's loop is from instability: how much more delay, motor lag, stiffness and mass it bears, "
        "predicted by the linear closed loop along the reference and measured by bisection in the simulation.",
    )
    margins.add_argument("scene", help="scene: a file, or a name of pcr-mpc models")
    margins.add_argument("--controller", type=Path, metavar="FILE|NAME",
                         help="tuning instead of the scene's own: a file, or a name of pcr-mpc models")  # fmt: skip
    margins.add_argument("--predicted", action="store_true", help="only predict: seconds instead of a minute or two")
    margins.add_argument("--poses", type=int, default=24, help="of the reference, at equal times (default 24)")
    margins.add_argument("--out", type=Path, help="folder for the results (default results/margins/SCENE_CONTROLLER)")
    margins.add_argument("--no-pictures", action="store_true", help="write the figures only")

    server = command(
        "serve",
        "serve",
        "serve",
        "Serve a scene's controller over UDP: a measurement comes, motor rates go back. docs/wire.md has the packets. "
        "Silence brings the motors to rest. Ctrl-C ends it.",
    )
    server.add_argument("scene", help="scene: a file, or a name of pcr-mpc models")
    server.add_argument("--controller", type=Path, metavar="FILE|NAME", help="tuning instead of the scene's own")
    server.add_argument("--listen", default="127.0.0.1:5005", metavar="HOST:PORT",
                        help="where to (default 127.0.0.1:5005; port 0 takes a free one)")  # fmt: skip
    server.add_argument("--anywhere", action="store_true", help="allow a host that is no loopback address: whoever can "
                        "send there moves the motors")  # fmt: skip
    server.add_argument("--silence", type=int, default=5, metavar="N", help="control periods without a measurement, "
                        "after which the motors come to rest (default 5)")  # fmt: skip

    loop = command(
        "hil",
        "serve",
        "hil",
        "Run a scene in real time, the plant in one process and the controller in another, over UDP on loopback: "
        "error, round trips, missed periods, as a table and a picture.",
    )
    loop.add_argument("scene", help="scene: a file, or a name of pcr-mpc models")
    loop.add_argument("--controller", type=Path, metavar="FILE|NAME", help="tuning instead of the scene's own")

    for served in (server, loop):
        served.add_argument("--generated", action="store_true", help="the controller as generated C, which is compiled "
                            "first, instead of Python's")  # fmt: skip
    loop.add_argument("--period", type=float, metavar="S", help="control period [s] (default: the scene's); the "
                      "tuning's weights stay")  # fmt: skip
    loop.add_argument("--duration", type=float, metavar="S", help="of the run [s] (default: the scene's)")
    loop.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default results/hil/NAME)")

    look = command(
        "view",
        "view",
        "view",
        "Show a scene live in a browser: the plant and its controller run, and you pull at the tip, move the target, "
        "turn motors, limits, load, noise and delay. docs/view.md says more. Ctrl-C ends it.",
    )
    look.add_argument("scene", help="scene: a file, or a name of pcr-mpc models")
    look.add_argument("--controller", type=tuning_or_class, metavar="FILE|NAME|MODULE:CLASS",
                      help="to begin with, instead of the scene's own")  # fmt: skip
    look.add_argument("--no-browser", action="store_true", help="open none; the address is on stderr")
    look.add_argument("--host", default="127.0.0.1", help="where to listen (default 127.0.0.1)")
    look.add_argument("--port", type=int, default=0, help="where to listen (default: a free one)")
    look.add_argument("--anywhere", action="store_true", help="allow a host that is no loopback address: whoever sees "
                      "the page's address there moves the robot")  # fmt: skip
    look.add_argument("--seed", type=int, default=0, help="of the measurement noise (default 0)")
    look.add_argument("--out", type=Path, metavar="DIR", help="folder for recordings (default results/view/NAME)")

    again = command(
        "replay",
        "view",
        "replay",
        "Put a recorded run into one page that plays it in any browser, without a server or a network.",
    )
    again.add_argument("record", type=Path, metavar="RUN", help="folder of a run, as track and view write it")
    again.add_argument("--out", type=Path, metavar="FILE", help="page to write (default replay.html beside the run)")
