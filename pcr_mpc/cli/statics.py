"""The commands of the command line that need a robot and no scene."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

from ..files import require_free, stamped, write_text
from ..plant.mujoco.mjcf import mjcf
from ..plant.robot import Robot, load_robot
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.free_tip import forward_statics, inverse_statics
from ..plant.statics.held_tip import solve_statics
from ..plant.statics.stability import all_equilibria, assess_stability


def solve_pose(options: argparse.Namespace) -> int:
    """Run `pcr-mpc statics`."""
    robot = load_robot(options.robot)
    if options.equilibria and options.picture is None:
        options.picture = Path("results") / "equilibria.png"
    if options.picture:
        require_free(options.picture, force=options.overwrite)
    q = options.q
    if options.method and (options.p is None or q is None):
        raise ValueError("--method goes with both --p and --q")
    if options.mode and (options.p is None or q is not None):
        raise ValueError("--mode goes with --p alone")
    if options.force is not None and options.p is not None and q is not None:
        raise ValueError("--force goes with --p alone or --q alone")
    force = options.force or (0.0, 0.0)
    if q is not None and options.degrees:
        q = [math.radians(angle) for angle in q]
    if q is not None:
        _question_angles(robot, q, "" if options.degrees else ", or add --degrees if these are degrees")
    if options.p is not None and q is not None:
        eq = solve_statics(robot, options.p, q, method=options.method or "closed_form")
    elif options.p is not None:
        eq = inverse_statics(robot, options.p, force, mode=options.mode)
    elif q is not None:
        eq = forward_statics(robot, q, force)
    else:
        raise ValueError("give --p, --q or both")
    from ..report.tables import equilibrium_record, equilibrium_table, strain_warnings

    if options.equilibria:
        return _equilibria(options, eq)
    print(json.dumps(equilibrium_record(eq)) if options.json else equilibrium_table(eq))
    for line in strain_warnings(eq):
        print(f"pcr-mpc: warning: {line}", file=sys.stderr)
    if options.picture:
        from ..report.plots import plot_equilibrium

        plot_equilibrium(eq, options.picture)
    return 0


def _question_angles(robot: Robot, q: list[float], advice: str) -> None:
    """Refuse angles that are more than a turn beyond the motors' stops."""
    for i, (angle, (lower, upper)) in enumerate(zip(q, robot.angle_limits, strict=False)):
        if not lower - 2 * math.pi <= angle <= upper + 2 * math.pi:
            raise ValueError(
                f"--q {angle:g} rad is more than a turn beyond the stops of motor {i}, [{lower:g}, {upper:g}] rad; "
                f"take off the whole turns{advice}"
            )


def _equilibria(options: argparse.Namespace, eq: Equilibrium) -> int:
    from ..report.plots import plot_equilibria
    from ..report.tables import equilibria_table, equilibrium_record

    found = all_equilibria(eq.robot, None if options.p is None else eq.p, eq.q, options.force or (0.0, 0.0))
    if options.json:
        records = [
            {**equilibrium_record(one), "unstable_directions": assess_stability(one).unstable_directions}
            for one in found
        ]
        print(json.dumps(records))
    else:
        print(equilibria_table(found))
    plot_equilibria(found, options.picture)
    print(f"drawn in {options.picture}", file=sys.stderr)
    return 0


def export(options: argparse.Namespace) -> int:
    """Run `pcr-mpc export`."""
    robot = load_robot(options.robot)
    require_free(options.out, force=options.overwrite)
    eq = inverse_statics(robot, options.p, mode=options.mode)
    write_text(options.out, stamped(mjcf(robot, pose=eq, links=options.links), ("<!-- ", " -->")))
    record = {"file": str(options.out), "links": options.links, "mode": eq.mode, "q": eq.q.tolist()}
    print(json.dumps(record) if options.json else f"{options.links} links a rod, mode {eq.mode}: {options.out}")
    return 0
