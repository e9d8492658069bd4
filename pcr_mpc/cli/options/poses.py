"""Commands about poses of a robot."""

from __future__ import annotations

from pathlib import Path

from ...methods import METHODS
from .command import LINKS, Command


def add(command: Command) -> None:
    """Add them."""
    statics = command(
        "statics",
        "statics",
        "solve_pose",
        "Solve a pose: give --p and --q, or one of them to find the other in balance with --force.",
    )
    statics.add_argument("robot", help="robot: a file, or a name such as planar_pair of pcr-mpc models")
    statics.add_argument("--p", type=float, nargs=2, metavar=("X", "Y"), help="tip position [m]")
    statics.add_argument("--q", type=float, nargs="+", metavar="A", help="motor angles [rad]")
    statics.add_argument("--degrees", action="store_true", help="motor angles are given in degrees")
    statics.add_argument("--force", type=float, nargs=2, metavar=("FX", "FY"),
                         help="external force on the tip [N], where p or q is to be found (default 0 0)")  # fmt: skip
    statics.add_argument("--mode", help="working mode to look for, a letter L or R per rod, such as LR")
    statics.add_argument("--method", choices=METHODS, help="where both p and q are given (default closed_form)")
    statics.add_argument(
        "--equilibria",
        action="store_true",
        help="list every equilibrium, with its verdict: with --p and --q of the held tip, with --q of the free one, "
        "with --p of the held tip at the motor angles that balance it",
    )
    statics.add_argument("--picture", type=Path, metavar="FILE", help="draw the pose into FILE")

    mjcf = command("export", "statics", "export", "Write a robot in balance as a model file of MuJoCo (MJCF).")
    mjcf.add_argument("robot", help="robot: a file, or a name such as planar_pair of pcr-mpc models")
    mjcf.add_argument("--p", type=float, nargs=2, metavar=("X", "Y"), required=True, help="tip position [m]")
    mjcf.add_argument("--mode", help="working mode, a letter L or R per rod, such as LR")
    mjcf.add_argument("--links", type=int, default=LINKS, help=f"of each rod (default {LINKS})")
    mjcf.add_argument("--out", type=Path, required=True, metavar="FILE", help="model file, such as planar_pair.xml")
