"""Commands about files of robots, scenes and tunings."""

from __future__ import annotations

from pathlib import Path

from ...catalogue import KINDS
from .command import Command


def add(command: Command) -> None:
    """Add them."""
    new = command(
        "new",
        "new",
        "new",
        "Write a robot, a scene and a tuning to start from into a folder: motors, tip, path and times are chosen so "
        "that they go together, and the numbers say why.",
    )
    new.add_argument("folder", type=Path, metavar="NAME", help="folder to make; its last part names the robot")
    new.add_argument("--rods", type=int, default=2, help="2 to 4 (default 2)")
    new.add_argument("--material", default="nitinol", help="of the rods, such as spring_steel (default nitinol)")
    new.add_argument("--diameter", type=float, metavar="D", help="of the rods [m] (default 0.001)")
    new.add_argument("--width", type=float, metavar="W", help="of rods that are upright strips [m], with --thickness "
                     "instead of a diameter: the tip does not sag")  # fmt: skip
    new.add_argument("--thickness", type=float, metavar="T", help="of such strips, in the plane of the robot [m]")
    new.add_argument("--length", type=float, default=0.5, metavar="L", help="of the rods [m] (default 0.5)")
    new.add_argument("--spacing", type=float, metavar="S", help="between neighbouring motors [m] (default: chosen)")
    new.add_argument("--tip-mass", type=float, metavar="M", help="pin and payload [kg] (default: chosen)")
    new.add_argument("--motor", help="servo, such as XM430-W210 (default: the smallest that has the torque)")

    check = command(
        "check",
        "new",
        "check",
        "Say all of a robot or a scene that can be said without running it: reach, working modes, torque, strain, "
        "natural frequencies, step sizes, margins, what the reference asks for. Fails if it cannot run as asked.",
    )
    check.add_argument("target", metavar="ROBOT|SCENE", help="a file, or a name of pcr-mpc models")
    check.add_argument("--picture", type=Path, metavar="FILE", help="draw start, workspace and reference into FILE")

    command("models", "shipped", "list_models", "List the robots, scenes and tunings that come with the package.")

    copy = command(
        "copy",
        "shipped",
        "copy",
        "Copy a scene that comes with the package, with its robot and tuning, into a folder, to be changed there.",
    )
    copy.add_argument("name", help="of a scene, or of a robot or tuning; pcr-mpc models lists them")
    copy.add_argument("folder", type=Path, help="where to; it is made if it is not there")
    copy.add_argument(
        "--kind", choices=KINDS, help=f"which is meant of one name (default: the first of {', '.join(KINDS)})"
    )
