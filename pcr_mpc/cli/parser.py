"""What the command line understands; loads nothing that takes time."""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import Any

from ..catalogue import KINDS
from ..methods import METHODS

_EXAMPLES = """\
examples:
  pcr-mpc track lemniscate                              closed loop, pictures and a table
  pcr-mpc track limited --json                          the same figures for a machine
  pcr-mpc track lemniscate --controller mine:Mine       a controller of your own, in mine.py
  pcr-mpc statics planar_pair --p 0 0.25 --mode LR      motor angles that hold the tip there
  pcr-mpc statics rfrfr --q 120 60 --degrees            where the free tip comes to rest
  pcr-mpc statics planar_pair --p 0.18 0.12 --equilibria           what else it could snap to
  pcr-mpc track lemniscate --plant mujoco               against another engine's robot
  pcr-mpc export planar_pair --p 0 0.25 --mode LR --out pair.xml   that robot as MJCF
  pcr-mpc plan waypoints --out fast.csv                 that path as fast as the robot can
  pcr-mpc choose vertical                               what physics the scene needs, and why
  pcr-mpc identify lemniscate run.csv --out mine.toml   a robot's numbers from recorded motion
  pcr-mpc excite lemniscate --duration 6                a motion worth recording
  pcr-mpc generate lemniscate --out build/lemniscate       controller and plant as C
  pcr-mpc fmu lemniscate --part plant                   for Simulink, Modelica and others, by FMI
  pcr-mpc hil lemniscate                                in real time, the controller over a wire
  pcr-mpc view lemniscate                               the robot live in a browser: pull at it
  pcr-mpc replay results/lemniscate                     a recorded run as one page
  pcr-mpc timing lemniscate                             step times against the real-time budgets
  pcr-mpc tune pick_and_place --trials 20 --jobs 2 --out better.toml   a better controller
  pcr-mpc margins lemniscate                            how much delay, lag and mismatch the loop bears
  pcr-mpc copy lemniscate mine                          a copy of that scene to change
  pcr-mpc new mine --diameter 1e-3 --length 0.5         a robot of your own to start from, in mine/
  pcr-mpc check mine/scene.toml                         what can be said of it without running it

Where a file is wanted, a name is one of pcr-mpc models; a path, such as ./mine/scene.toml, is that file.
"""

LINKS = 40
_CLASS = re.compile(r".+:[A-Za-z_]\w*")
# Least values of the options that are whole numbers.
LEAST = {"seed": 0, "links": 2, "steps": 1, "trials": 1, "jobs": 1, "episodes": 1, "cells": 8, "poses": 1, "silence": 1}


def tuning_or_class(text: str) -> Path | str:
    """Path of a tuning, or ``module:Class`` as it stands."""
    return text if _CLASS.fullmatch(text) and not Path(text).exists() else Path(text)


class _Version(argparse.Action):
    """Looks the version up only where it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"pcr-mpc {version('pcr_mpc')}")
        parser.exit()


def parser() -> argparse.ArgumentParser:
    """Build the parser; ``run`` of what it parses is module and function, so that only what is needed is loaded."""
    top = argparse.ArgumentParser(
        prog="pcr-mpc",
        description="Model-predictive control of planar parallel continuum robots.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    top.add_argument("--version", action=_Version, nargs=0, help="show the version and exit")
    commands = top.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, module: str, run: str, text: str) -> argparse.ArgumentParser:
        sub = commands.add_parser(name, help=text, description=text)
        # Python 3.14's pattern; before, argparse takes -1e-2 for an option.
        sub._negative_number_matcher = re.compile(r"-\.?\d")
        sub.set_defaults(run=(module, run))
        sub.add_argument("--json", action="store_true", help="print one JSON object on stdout instead of tables")
        sub.add_argument("--traceback", action="store_true", help="show the traceback of a failure")
        # The force of `statics` is one in newtons.
        flags = ("--overwrite",) if name == "statics" else ("--force", "--overwrite")
        if name in ("copy", "new"):
            sub.add_argument(*flags, dest="overwrite", action="store_true", help="overwrite files that are there")
        elif name not in ("choose", "models"):
            sub.add_argument(*flags, dest="overwrite", action="store_true",
                             help="overwrite files that pcr-mpc did not write, or that were changed since")  # fmt: skip
        return sub

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
    for served in (server, loop):
        served.add_argument("--generated", action="store_true", help="the controller as generated C, which is compiled "
                            "first, instead of Python's")  # fmt: skip
    loop.add_argument("--period", type=float, metavar="S", help="control period [s] (default: the scene's); the "
                      "tuning's weights stay")  # fmt: skip
    loop.add_argument("--duration", type=float, metavar="S", help="of the run [s] (default: the scene's)")
    loop.add_argument("--out", type=Path, metavar="DIR", help="folder for the results (default results/hil/NAME)")

    timing = command(
        "timing",
        "study",
        "time_loop",
        "Time plant steps of every method and the control step against their budgets; draw it.",
    )
    timing.add_argument("scene", help="scene: a file, or a name of pcr-mpc models")
    timing.add_argument("--steps", type=int, default=100_000,
                        help="plant steps and control steps (default 100000: two or three minutes)")  # fmt: skip
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
    return top
