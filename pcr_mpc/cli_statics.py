"""The commands of the command line that need a robot and no scene."""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path

from .plant.equilibrium import Equilibrium
from .plant.free_tip import forward_statics, inverse_statics
from .plant.mjcf import mjcf
from .plant.robot import load_robot
from .plant.stability import all_equilibria, assess_stability
from .plant.statics import solve_statics


def solve_pose(options: argparse.Namespace) -> int:
    """Run `pcr-mpc statics`."""
    robot = load_robot(options.robot)
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
    if options.p is not None and q is not None:
        eq = solve_statics(robot, options.p, q, method=options.method or "closed_form")
    elif options.p is not None:
        eq = inverse_statics(robot, options.p, force, mode=options.mode)
    elif q is not None:
        eq = forward_statics(robot, q, force)
    else:
        raise ValueError("give --p, --q or both")
    from .report.tables import equilibrium_record, equilibrium_table

    if options.equilibria:
        return _equilibria(options, eq)
    print(json.dumps(equilibrium_record(eq)) if options.json else equilibrium_table(eq))
    if options.picture:
        from .report.plots import plot_equilibrium

        plot_equilibrium(eq, options.picture)
    return 0


def _equilibria(options: argparse.Namespace, eq: Equilibrium) -> int:
    from .report.plots import plot_equilibria
    from .report.tables import equilibria_table, equilibrium_record

    found = all_equilibria(eq.robot, None if options.p is None else eq.p, eq.q, options.force or (0.0, 0.0))
    if options.json:
        records = [
            {**equilibrium_record(one), "unstable_directions": assess_stability(one).unstable_directions}
            for one in found
        ]
        print(json.dumps(records))
    else:
        print(equilibria_table(found))
    picture = options.picture or Path("results") / "equilibria.png"
    picture.parent.mkdir(parents=True, exist_ok=True)
    plot_equilibria(found, picture)
    print(f"drawn in {picture}", file=sys.stderr)
    return 0


def export(options: argparse.Namespace) -> int:
    """Run `pcr-mpc export`."""
    robot = load_robot(options.robot)
    eq = inverse_statics(robot, options.p, mode=options.mode)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(mjcf(robot, pose=eq, links=options.links), encoding="utf-8")
    record = {"file": str(options.out), "links": options.links, "mode": eq.mode, "q": eq.q.tolist()}
    print(json.dumps(record) if options.json else f"{options.links} links a rod, mode {eq.mode}: {options.out}")
    return 0
