"""Commands that search: a quicker path, enough physics, a robot's numbers, a better tuning."""

from __future__ import annotations

from pathlib import Path

from .command import Command


def add(command: Command) -> None:
    """Add them."""
    plan = command(
        "plan",
        "plan",
        "plan",
        "Time a scene's path anew, as fast as the robot can follow it; write it as a path to track, and draw it.",
    )
    plan.add_argument("scene", help="scene: a file, or a name of pcr-mpc models; its reference is the path")
    plan.add_argument("--out", type=Path, metavar="FILE", help="path to write, for a reference of kind file "
                      "(default results/plan/NAME.csv); the picture is beside it")  # fmt: skip
    plan.add_argument("--tip-speed", type=float, metavar="V", help="largest speed of the tip [m/s] (default: none)")
    plan.add_argument("--tip-acceleration", type=float, metavar="A",
                      help="largest acceleration of the tip [m/s^2] (default: none)")  # fmt: skip
    plan.add_argument("--tip-jerk", type=float, metavar="J", help="largest jerk of the tip [m/s^3] (default: none)")
    plan.add_argument("--tolerance", type=float, default=0.05, metavar="D",
                      help="distance by which the path may be smoothed [mm] (default 0.05)")  # fmt: skip
    plan.add_argument("--free", action="store_true",
                      help="let go of the path between the way-points of a spline or of waypoints too")  # fmt: skip
    plan.add_argument("--cells", type=int, help="pieces of the timing (default: of 10 ms each, 80 to 240)")
    plan.add_argument("--no-pictures", action="store_true", help="write the path only")

    choice = command(
        "choose",
        "study",
        "choose_rung",
        "Find the lowest physics and the cheapest discretisation that meet what a scene's [need] table asks for.",
    )
    choice.add_argument("scene", help="scene: a file, or a name of pcr-mpc models")
    choice.add_argument("--write", action="store_true", help="put the chosen rung into the scene's [plant] table")

    identity = command(
        "identify",
        "identify",
        "identify_robot",
        "Find a robot's numbers from logs of its motion: stiffness, mass, drag, bases, delay and load, with what the "
        "logs cannot tell.",
    )
    identity.add_argument("scene", help="scene: a file, or a name of pcr-mpc models; its robot is what is believed")
    identity.add_argument("logs", nargs="+", metavar="LOG", help="run.csv or run.npz of `track`, or a CSV file with "
                          "columns t_s, p_x_m, p_y_m, q0_rad, ..., u0_rad_s, ... at a uniform rate; cells may be "
                          "empty and rows missing")  # fmt: skip
    identity.add_argument("--free", action="append", metavar="NAMES", help="what is unknown, separated by commas: "
                          "bending_stiffness, length, base, line_density (of all rods, or as rods[0].length), "
                          "tip_mass, drag, motor_zero, tip_offset, delay, force; default stands for "
                          "bending_stiffness, tip_mass, drag, base, delay and force, as in --free "
                          "default,motor_zero")  # fmt: skip
    identity.add_argument("--fix", action="append", default=[], metavar="NAME=VALUE", help="a number that is known, "
                          "in SI units, as tip_mass=0.251 of a tip that was weighed; delay in control "
                          "periods")  # fmt: skip
    identity.add_argument("--validate", action="append", default=[], metavar="LOG", help="log that is only predicted")
    identity.add_argument("--loss", choices=("auto", "squares", "huber"), default="auto",
                          help="huber bears outliers; auto takes it where there are some (default)")  # fmt: skip
    identity.add_argument("--robust", action="store_true", help="the same as --loss huber")
    identity.add_argument("--out", type=Path, metavar="FILE", help="robot file to write, with an [uncertainty] table "
                          "that a later call starts from")  # fmt: skip
    identity.add_argument("--results", type=Path, metavar="FOLDER", help="for table and picture (default "
                          "results/identify/SCENE)")  # fmt: skip

    excitation = command(
        "excite",
        "identify",
        "excite_robot",
        "Find a motion worth recording: the one from which a robot's numbers would be told best, within its limits. "
        "Shows how well before anything is recorded; writes the path, and a scene that tracks it.",
    )
    excitation.add_argument("scene", help="scene: a file, or a name of pcr-mpc models; robot, start, limits, sensors")
    excitation.add_argument("--duration", type=float, required=True, metavar="S", help="of the motion [s]")
    excitation.add_argument("--trials", type=int, default=30, help="motions to try (default 30, some seconds each)")
    excitation.add_argument("--seed", type=int, default=0, help="of the trials (default 0)")
    excitation.add_argument("--out", type=Path, metavar="FOLDER", help="for path, scene, table and picture (default "
                            "results/excite/SCENE)")  # fmt: skip

    tuning = command(
        "tune",
        "study",
        "tune_controller",
        "Search for a better tuning of a scene's linear MPC, with Optuna; write it if there is one. "
        "A study goes on where the last call with the same settings ended.",
    )
    tuning.add_argument("scene", help="scene: a file, or a name of pcr-mpc models")
    tuning.add_argument("--start", metavar="FILE", help="tuning to beat (default: the scene's; default.toml "
                        "beside it if that is from an earlier search)")  # fmt: skip
    tuning.add_argument("--trials", type=int, default=50, help="to add to the study (default 50)")
    tuning.add_argument("--jobs", type=int, default=1, help="processes on this machine (default 1)")
    tuning.add_argument("--storage", metavar="URL", help="Optuna storage, for several machines "
                      "(default SQLite in results/tune/SCENE)")  # fmt: skip
    tuning.add_argument("--episodes", type=int, default=24, help="with mismatch, in each trial (default 24: a "
                        "study that sees no failure, which is rare, takes a fragile tuning for the best)")  # fmt: skip
    tuning.add_argument("--keep-period", action="store_true", help="the control period is given: search the rest")
    tuning.add_argument("--seed", type=int, default=0, help="of the first episode (default 0)")
    tuning.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="tuning to write (default SCENE.toml, beside the scene's tuning if the scene is a file)",
    )
