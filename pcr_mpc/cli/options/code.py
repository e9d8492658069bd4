"""Commands that write C."""

from __future__ import annotations

from pathlib import Path

from .command import Command


def add(command: Command) -> None:
    """Add them."""
    code = command(
        "generate",
        "generate",
        "generate",
        "Write the controller and the plant of a scene as C that compiles by itself, with an example that closes the "
        "loop and is held against Python's run.",
    )
    code.add_argument("scene", help="scene: a file, or a name of pcr-mpc models")
    code.add_argument("--controller", type=Path, metavar="FILE|NAME", help="tuning instead of the scene's own: a "
                      "file, or a name of pcr-mpc models")  # fmt: skip
    code.add_argument("--solver", choices=("osqp", "daqp"), help="QP solver (default: the tuning's)")
    code.add_argument("--float32", action="store_true", help="single precision, for processors without double: it is "
                      "compiled and run here, what it costs is told, and refused where it is of no use")  # fmt: skip
    code.add_argument("--out", type=Path, metavar="DIR", help="folder to write (default build/NAME)")

    unit = command(
        "fmu",
        "fmu",
        "fmu",
        "Pack the plant or the controller of a scene as a functional mock-up unit (FMI, co-simulation), for Simulink, "
        "Modelica tools and others to import: the C of `generate` with a binary for this computer. docs/fmu.md has "
        "its variables, and how to couple the two.",
    )
    unit.add_argument("scene", help="scene: a file, or a name of pcr-mpc models")
    unit.add_argument("--part", choices=("plant", "controller"), required=True, help="what it is a model of")
    unit.add_argument("--version", type=int, choices=(2, 3), default=2,
                      help="of FMI; 2 is what most tools read (default 2)")  # fmt: skip
    unit.add_argument("--controller", type=Path, metavar="FILE|NAME", help="tuning instead of the scene's own: a "
                      "file, or a name of pcr-mpc models")  # fmt: skip
    unit.add_argument("--out", type=Path, metavar="FILE", help="file to write (default build/pcr_SCENE_PART.fmu)")
