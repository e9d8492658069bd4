"""Where can the default robot hold its tip, how stiffly, and what ends its workspace?

The motors hold the tip in balance (F = 0). From one pose of a working mode, every tip of a triangular lattice is
reached by continuation from its neighbours (predictor and Newton's method on the motor angles; through arc length
where the motors turn fast), and a path of the tip ends where the branch does:

  type 2     an eigenvalue of K passes zero: the tip would snap
  type 1     det G passes zero: the motors lose a direction of force, two inverse solutions merge
  rod limit  a rod alone, tip held, would buckle (lambda = lambda_c)
  reach      a rod is stretched to 0.995 of its length
  overlap    the tip was reached another way with other motor angles
  lost       none of these was seen, but Newton's method went no further

The stops of the motors do not end the search; they are drawn over the result. Colour is the smallest eigenvalue of K:
the force per metre that moves the tip in its softest direction. Motor angles a full turn apart count as one. Poses
beyond a type 1 curve (the other inverse solution, of the same letters) are not searched.

Writes one picture a mode (tip space, motor space), a CSV with a row for every tip and mode, failures included, and one
with the points found on the edges, each within 5e-4 rad of arc (5e-5 m of tip motion) of the end.
"""

from __future__ import annotations

import argparse
import itertools
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.patches import PathPatch
from matplotlib.path import Path as MarkerPath

from pcr_mpc import Robot, assess_stability, inverse_statics, load_robot
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import GREY, ORANGE, PURPLE, RED, SKY, plt
from pcr_mpc.study.workspace_sheet import REACH, End, Mesh, Sheet, Site, explore, make_mesh, neighbours, turn_between

MODES = ("LR", "RL", "LL")
POSE_COLUMNS = ("mode", "x", "y", "q0", "q1", "stable", "within_stops", "k_soft", "k_stiff", "motor_authority", "det_g",
                "rod_margin_0", "rod_margin_1", "failure")  # fmt: skip
EDGE_COLUMNS = ("mode", "reason", "x", "y", "q0", "q1")
SEED_TIP = (0.0, 0.15)  # m; held in every mode within the stops
COLOURS = {"type 2": RED, "type 1": PURPLE, "rod limit": ORANGE, "reach": GREY, "overlap": SKY, "lost": "black"}
LABELS = {
    "type 2": "type 2: the tip snaps",
    "type 1": "type 1: motors lose a direction",
    "rod limit": "limit of a rod",
    "reach": f"rod stretched to {REACH} L",
    "overlap": "overlap",
    "lost": "lost",
}
SOFTEST, STIFFEST = 1.0, 200.0  # N/m, ends of the colour scale


def stop_distance(robot: Robot, q: np.ndarray) -> float:
    """How far a motor is beyond its nearer stop, the worst of all; negative within [rad]."""
    lower, upper = robot.angle_limits.T
    return float((np.abs(turn_between((lower + upper) / 2, q)) - (upper - lower) / 2).max())


def in_window(robot: Robot, q: np.ndarray) -> np.ndarray:
    """The same motor angles within half a turn of the middle of each range [rad]."""
    middle = robot.angle_limits.mean(axis=1)
    return np.asarray(middle + turn_between(middle, q))


def connected_within_stops(sheet: Sheet) -> set[Site]:
    """Sites that the motors reach from the first pose without leaving their stops."""
    first = next(iter(sheet.poses))
    found, waiting = {first}, [first]
    while waiting:
        site = waiting.pop()
        for other in neighbours(site):
            if (
                other not in found
                and sheet.linked(site, other)
                and stop_distance(sheet.robot, sheet.poses[other].q) <= 0
            ):
                found.add(other)
                waiting.append(other)
    return found


def areas(sheet: Sheet) -> dict[str, float]:
    """Areas in tip space, in units of L^2 [-]: the whole sheet, within the stops, and the connected part of that."""
    mesh = make_mesh(sheet)
    inside = np.array([stop_distance(sheet.robot, eq.q) <= 0 for eq in mesh.vertices])
    connected = connected_within_stops(sheet)
    joined = inside & np.array([site in connected for site in mesh.sites])
    p = np.array([eq.p for eq in mesh.vertices]) / sheet.robot.lengths.min()
    total = np.zeros(3)
    for polygon in mesh.polygons:
        x, y = p[polygon].T
        area = float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2
        total += area * np.array([1.0, inside[polygon].mean(), joined[polygon].mean()])
    return dict(zip(("stable", "within_stops", "connected_within_stops"), total.tolist(), strict=True))


def pose_rows(sheet: Sheet, mode: str) -> list[dict[str, object]]:
    """One row for each tip within reach: the pose that holds it, or why there is none."""
    rows: list[dict[str, object]] = []
    for site, p in sheet.tips.items():
        row: dict[str, object] = {"mode": mode, "x": f"{p[0]:.6f}", "y": f"{p[1]:.6f}"}
        if site in sheet.poses:
            eq = sheet.poses[site]
            verdict = assess_stability(eq)
            figures = {
                **dict(zip(("q0", "q1"), in_window(sheet.robot, eq.q), strict=True)),
                **dict(zip(("k_soft", "k_stiff"), verdict.stiffness_eigenvalues, strict=True)),
                **dict(zip(("rod_margin_0", "rod_margin_1"), verdict.rod_margins, strict=True)),
                "motor_authority": verdict.motor_authority,
                "det_g": float(np.linalg.det(eq.dforce_dq)),
            }
            row.update({name: f"{value:.6g}" for name, value in figures.items()})
            row |= {"stable": verdict.stable, "within_stops": stop_distance(sheet.robot, eq.q) <= 0}
        else:
            towards = [end for (_, to), end in sheet.ends.items() if to == site]
            row["failure"] = describe(towards[0]) if towards else "not tried: none of its neighbours has a pose"
        rows.append(row)
    return rows


def describe(end: End) -> str:
    """One line about where a path ended, with the figures that show why."""
    eq, verdict = end.pose, assess_stability(end.pose)
    return (
        f"{end.reason}: the path to this tip ends at p = {eq.p.round(5)} m, q = {eq.q.round(4)} rad, where K has "
        f"eigenvalues {eq.stiffness_eigenvalues.round(4)} N/m, G the smallest singular value "
        f"{verdict.motor_authority:.3g} N/rad, and the rods are at {(1 - verdict.rod_margins).round(3)} of their limits"
    )


def edge_rows(sheet: Sheet, mode: str) -> list[dict[str, object]]:
    """One row for each point found on the edge of the sheet: the last stable pose before it, and the reason."""
    rows: list[dict[str, object]] = []
    for end in sheet.ends.values():
        values = [*end.pose.p, *in_window(sheet.robot, end.pose.q)]
        texts = [mode, end.reason, *(f"{value:.6g}" for value in values)]
        rows.append(dict(zip(EDGE_COLUMNS, texts, strict=True)))
    return rows


def plot(sheet: Sheet, mode: str, path: Path) -> None:
    """Left: tip positions; right: the motor angles that hold them, over one turn around the middle of their range."""
    robot, mesh = sheet.robot, make_mesh(sheet)
    figure, (tip, motors) = plt.subplots(1, 2, figsize=(11, 5.7), layout="constrained")
    p = np.array([eq.p for eq in mesh.vertices])
    q = np.array([in_window(robot, eq.q) for eq in mesh.vertices])
    colours = draw_sheet(tip, mesh, p[mesh.triangles()], p[mesh.border])
    for turns in itertools.product((-1, 0, 1), repeat=2):
        # What crosses the edge of the window is drawn whole, at either side.
        places = [unwrapped(q[indices] + 2 * np.pi * np.array(turns)) for indices in (mesh.triangles(), mesh.border)]
        draw_sheet(motors, mesh, *places)
    draw_stops(tip, motors, mesh, p)
    first = next(iter(sheet.poses.values()))
    for line in first.shape(60):
        tip.plot(*line.T, color="black", lw=1.2)
        tip.plot(*line[0], "s", color="black", ms=6)
    tip.plot(*first.p, "o", color="black", ms=5)
    tip.set(xlabel="x [m]", ylabel="y [m]", title=f"Tip space, mode {mode}")
    shown = np.concatenate([p, *first.shape(60)])
    low, high = shown.min(axis=0) - 0.02, shown.max(axis=0) + 0.02
    tip.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    middle = robot.angle_limits.mean(axis=1)
    motors.set(xlabel="motor angle q0 [rad]", ylabel="motor angle q1 [rad]", title="Motor space")
    motors.set(xlim=(middle[0] - np.pi, middle[0] + np.pi), ylim=(middle[1] - np.pi, middle[1] + np.pi))
    for axes in (tip, motors):
        axes.set_aspect("equal")
        axes.grid(False)
    label = "softest stiffness of the tip [N/m]"
    figure.colorbar(colours, ax=[tip, motors], label=label, extend="both", pad=0.02, shrink=0.85)
    handles = [plt.Line2D([], [], color=COLOURS[r], lw=3, label=LABELS[r]) for r in LABELS if r in mesh.reasons]
    handles.append(plt.Line2D([], [], color="black", ls="--", label="stops of the motors (pale: beyond)"))
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles))
    figure.savefig(path)
    plt.close(figure)


def draw_sheet(axes: Any, mesh: Mesh, triangles: np.ndarray, border: np.ndarray) -> Any:
    """Draw stiffness and edge, placed at (T, 3, 2) and (B, 2, 2)."""
    softest = np.array([eq.stiffness_eigenvalues[0] for eq in mesh.vertices])[mesh.triangles()]
    colours = axes.tripcolor(
        *triangles.reshape(-1, 2).T,
        np.arange(softest.size).reshape(-1, 3),
        softest.ravel(),
        shading="gouraud",
        cmap="viridis",
        norm=LogNorm(SOFTEST, STIFFEST),
    )
    edge = LineCollection(
        list(border), colors=[COLOURS[r] for r in mesh.reasons], linewidths=3, capstyle="round", zorder=3
    )
    axes.add_collection(edge)
    return colours


def draw_stops(tip: Any, motors: Any, mesh: Mesh, p: np.ndarray) -> None:
    """Fade what the stops of the motors forbid, and draw the line on which a motor meets one."""
    robot = mesh.vertices[0].robot
    beyond = np.array([stop_distance(robot, eq.q) for eq in mesh.vertices])
    if beyond.min() < 0 < beyond.max():
        tip.tricontourf(*p.T, mesh.triangles(), beyond, levels=[0, np.pi], colors="white", alpha=0.55)
        tip.tricontour(*p.T, mesh.triangles(), beyond, levels=[0], colors="black", linestyles="--", linewidths=1.6)
    lower, upper = robot.angle_limits.T
    around = [plt.Rectangle(lower - 2 * np.pi, *(upper - lower + 4 * np.pi)), plt.Rectangle(lower, *(upper - lower))]
    outer, inner = (patch.get_patch_transform().transform_path(patch.get_path()) for patch in around)
    # Wound the other way round, the inner rectangle is a hole.
    frame = MarkerPath.make_compound_path(outer, MarkerPath(inner.vertices[::-1], inner.codes))
    motors.add_patch(PathPatch(frame, color="white", alpha=0.55, lw=0))
    motors.add_patch(plt.Rectangle(lower, *(upper - lower), fill=False, ls="--", lw=1.6, zorder=4))


def unwrapped(angles: np.ndarray) -> np.ndarray:
    """Motor angles of shape (..., k, n), each row of k within half a turn of its first."""
    return np.asarray(angles[..., :1, :] + turn_between(angles[..., :1, :], angles))


def main() -> None:
    """Explore each mode, write the CSVs, draw, print the areas."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/workspace"), help="folder for pictures and CSVs")
    parser.add_argument("--modes", nargs="+", default=list(MODES), choices=("LR", "RL", "LL", "RR"),
                        help="sides to which the rods bow at their tips (default LR RL LL; RR mirrors LL)")  # fmt: skip
    parser.add_argument("--spacing", type=float, default=12.0, help="of the lattice of tips [mm] (default 12)")
    parser.add_argument("--quick", action="store_true", help="the first 40 tips of mode LL, 30 mm apart: some seconds")
    options = parser.parse_args()
    modes, spacing, most = (["LL"], 0.03, 40) if options.quick else (options.modes, 1e-3 * options.spacing, None)
    options.out.mkdir(parents=True, exist_ok=True)
    robot = load_robot(Path(__file__).parents[2] / "models" / "planar_pair.toml")
    poses: list[dict[str, object]] = []
    edges: list[dict[str, object]] = []
    for mode in modes:
        sheet = explore(inverse_statics(robot, SEED_TIP, mode=mode), spacing, most)
        poses += pose_rows(sheet, mode)
        edges += edge_rows(sheet, mode)
        plot(sheet, mode, options.out / ("workspace.png" if mode == "LR" else f"workspace_{mode}.png"))
        figures = ", ".join(f"{name.replace('_', ' ')} {value:.3f}" for name, value in areas(sheet).items())
        ends = Counter(end.reason for end in sheet.ends.values())
        print(f"mode {mode}: areas in L^2: {figures}; points on the edge: {dict(ends)}")
    write_rows(options.out / "workspace.csv", poses, POSE_COLUMNS)
    write_rows(options.out / "workspace_edge.csv", edges, EDGE_COLUMNS)
    print(f"written to {options.out}")


if __name__ == "__main__":
    main()
