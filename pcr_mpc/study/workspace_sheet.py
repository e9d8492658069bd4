"""A sheet of poses of one working mode: walked over a grid of tips to where it ends, and why it ends there."""

from __future__ import annotations

import itertools
from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from tqdm import tqdm

from ..errors import PCRError
from ..plant.robot import Robot
from ..plant.rods.method import closed_form_method
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.free_tip import inverse_statics
from ..plant.statics.solver import RodSolver

Site = tuple[int, int]
NEIGHBOURS: tuple[Site, ...] = ((1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1))  # counter-clockwise
REACH = 0.995  # of a rod's length, to which the tip may go
BALANCED = 1e-9  # |F| over sum EI/L^2
METRES_PER_RADIAN = 0.1  # in which tip and motor steps are compared
FIRST_STEP, LONGEST_STEP, SHORTEST_STEP = 0.1, 0.3, 5e-4  # rad
MOST_STEPS = 300
SAME = 1e-4  # rad


@dataclass(frozen=True, eq=False)
class End:
    """Where a straight path of the tip ended.

    Attributes
    ----------
    pose : Equilibrium
        The last one that was stable.
    reason : str
        A key of `LABELS`.
    """

    pose: Equilibrium
    reason: str


@dataclass(eq=False)
class Sheet:
    """The poses of one working mode, connected by stable motion.

    Attributes
    ----------
    robot : Robot
    spacing : float
        Of the lattice [m].
    tips : dict
        Site of the lattice -> tip position [m], for every tip within reach.
    poses : dict
        Site -> its pose, where there is one.
    ends : dict
        (site, neighbouring site) -> where the path between them ended.
    """

    robot: Robot
    spacing: float
    tips: dict[Site, np.ndarray]
    poses: dict[Site, Equilibrium] = field(default_factory=dict)
    ends: dict[tuple[Site, Site], End] = field(default_factory=dict)

    def position(self, site: Site) -> np.ndarray:
        """Tip position of a site, within reach or not [m]."""
        return self.spacing * np.array([site[0] + (site[1] + 1) / 2, np.sqrt(0.75) * site[1]])

    def linked(self, a: Site, b: Site) -> bool:
        """Whether a stable motion along their edge connects the poses of two neighbours."""
        return a in self.poses and b in self.poses and (a, b) not in self.ends and (b, a) not in self.ends


def make_sheet(robot: Robot, spacing: float) -> Sheet:
    """Lattice without poses, mirror-symmetric about both axes."""
    sheet = Sheet(robot, spacing, {})
    most = int(2 * robot.lengths.max() / spacing) + 1
    for i, j in itertools.product(range(-most, most + 1), repeat=2):
        p = sheet.position((i, j))
        if stretch(robot, p) < 1:
            sheet.tips[i, j] = p
    return sheet


def stretch(robot: Robot, p: np.ndarray) -> float:
    """Largest distance from the tip to a base over the length of the rod."""
    return float((np.linalg.norm(p - robot.bases, axis=1) / robot.lengths).max())


def turn_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Motor angles from ``a`` to ``b`` up to full turns, each within pi of zero [rad]."""
    return np.asarray((b - a + np.pi) % (2 * np.pi) - np.pi)


def motor_rates(eq: Equilibrium) -> np.ndarray:
    """dq/dp that keeps the tip in balance, -G^-1 K [rad/m]."""
    return -np.linalg.solve(eq.dforce_dq, eq.dforce_dp)


def step(
    solver: RodSolver, start: Equilibrium, direction: np.ndarray, size: float, *, to_tip: bool
) -> Equilibrium | str:
    """One step along the branch while the tip moves straight, from the pose at which the solver stands.

    F(start.p + s direction, q) = 0 is a curve in (s, q). Its tangent predicts; Newton's method corrects, at the wanted
    tip (``to_tip``, size in m) or in the plane across the tangent (size in rad), where it passes a fold of q(s).

    Returns
    -------
    Equilibrium or str
        The pose, or why it is not one to go on from.
    """
    robot = solver.robot
    tolerance = BALANCED * float((robot.stiffnesses / robot.lengths**2).sum())
    scaled = METRES_PER_RADIAN * direction
    tangent = np.append(1.0, motor_rates(start) @ scaled)
    if to_tip:
        predicted, across = tangent * size / METRES_PER_RADIAN, np.array([1.0, 0.0, 0.0])
    else:
        across = tangent / np.linalg.norm(tangent)
        predicted = across * size
    length = float(np.linalg.norm(predicted))
    if length > LONGEST_STEP:
        return "lost"
    moved = predicted
    try:
        for _ in range(6):
            p, q = start.p + moved[0] * scaled, start.q + moved[1:]
            if stretch(robot, p) >= 1:
                return "reach"
            solver.move(p, q, continuation=False)
            force, (stiffness, coupling) = solver.force(), solver.jacobians()
            if np.linalg.norm(force) <= tolerance:
                break
            jacobian = np.vstack([np.column_stack([stiffness @ scaled, coupling]), across])
            moved = moved - np.linalg.solve(jacobian, np.append(force, across @ (moved - predicted)))
        else:
            return "lost"
    except (PCRError, np.linalg.LinAlgError):
        return "lost"
    if np.linalg.norm(moved - predicted) > 0.3 * length + SAME:
        return "lost"  # the branch is too curved for this step, or it is another one
    if solver.unstable_rods():
        return "rod limit"
    if np.linalg.det(coupling) * np.linalg.det(start.dforce_dq) <= 0:
        return "type 1"
    pose = solver.equilibrium(p, q)
    return pose if pose.stable else "type 2"


def follow(solver: RodSolver, start: Equilibrium, target: np.ndarray) -> Equilibrium | End:
    """Follow the balanced stable pose while the tip moves straight to ``target``."""
    direction = (target - start.p) / np.linalg.norm(target - start.p)
    distance = min(float(np.linalg.norm(target - start.p)), distance_to_reach(solver.robot, start.p, direction))
    pose, size, reason = start, FIRST_STEP, "lost"
    solver.start(pose.p, pose.q, pose.nodes)
    for _ in range(MOST_STEPS):
        left = distance - float((pose.p - start.p) @ direction)
        trial = step(solver, pose, direction, left, to_tip=True)
        if isinstance(trial, Equilibrium):
            return trial if np.allclose(trial.p, target, atol=1e-9) else End(trial, "reach")
        while True:
            go_back(solver, pose)
            if size < SHORTEST_STEP:
                return End(pose, reason)
            trial = step(solver, pose, direction, size, to_tip=False)
            if isinstance(trial, Equilibrium) and (trial.p - start.p) @ direction < distance:
                break
            size, reason = size / 2, trial if isinstance(trial, str) else "lost"
        pose, size = trial, min(1.5 * size, LONGEST_STEP)
    return End(pose, "lost")


def go_back(solver: RodSolver, pose: Equilibrium) -> None:
    """Take the solver, which is near, back to a pose."""
    try:
        solver.move(pose.p, pose.q)
    except PCRError:
        solver.start(pose.p, pose.q, pose.nodes)


def distance_to_reach(robot: Robot, p: np.ndarray, direction: np.ndarray) -> float:
    """How far the tip may go before a rod is stretched to `REACH` [m]."""
    arm = p - robot.bases
    along = arm @ direction
    return float((np.sqrt(along**2 + (REACH * robot.lengths) ** 2 - (arm**2).sum(axis=1)) - along).min())


def explore(start: Equilibrium, spacing: float, most: int | None = None, *, progress: bool = True) -> Sheet:
    """All poses of the lattice that stable motion connects with ``start``, or the first ``most`` of them."""
    sheet = make_sheet(start.robot, spacing)
    solver = RodSolver(start.robot, closed_form_method())
    first = min(sheet.tips, key=lambda site: float(np.linalg.norm(sheet.tips[site] - start.p)))
    sheet.poses[first] = inverse_statics(start.robot, sheet.tips[first], guess=start)
    waiting = deque([first])
    with tqdm(total=most or len(sheet.tips), desc=f"mode {start.mode}", unit="tip", disable=not progress) as bar:
        while waiting:
            bar.update()
            site = waiting.popleft()
            pose = sheet.poses[site]
            for neighbour in neighbours(site):
                known = sheet.poses.get(neighbour)
                if known is not None and smooth_between(pose, known):
                    continue
                reached = follow(solver, pose, sheet.position(neighbour))
                if isinstance(reached, End):
                    sheet.ends[site, neighbour] = reached
                elif known is None:
                    if most is None or len(sheet.poses) < most:
                        sheet.poses[neighbour] = reached
                        waiting.append(neighbour)
                elif np.abs(turn_between(known.q, reached.q)).max() > SAME:
                    sheet.ends[site, neighbour] = End(pose, "overlap")
    return sheet


def neighbours(site: Site) -> list[Site]:
    """The six around a site, counter-clockwise."""
    return [(site[0] + i, site[1] + j) for i, j in NEIGHBOURS]


def smooth_between(a: Equilibrium, b: Equilibrium) -> bool:
    """Whether the tangents at both poses account for the motor motion between them: they are on one sheet."""
    if np.linalg.det(a.dforce_dq) * np.linalg.det(b.dforce_dq) <= 0:
        return False
    predicted = (motor_rates(a) + motor_rates(b)) @ (b.p - a.p) / 2
    return bool(
        np.linalg.norm(predicted) < LONGEST_STEP
        and np.linalg.norm(turn_between(a.q, b.q) - predicted) < 0.1 * np.linalg.norm(predicted) + SAME
    )


@dataclass(frozen=True, eq=False)
class Mesh:
    """A sheet cut into polygons, up to its edge.

    Attributes
    ----------
    vertices : list of Equilibrium
        Poses of the sites, then the ends.
    sites : list of tuple
        The site each vertex belongs to.
    polygons : list of list of int
        Counter-clockwise in tip space.
    border : ndarray, shape (B, 2)
        Vertices at both ends of each stretch of the edge.
    reasons : list of str
        Why the sheet ends there.
    """

    vertices: list[Equilibrium]
    sites: list[Site]
    polygons: list[list[int]]
    border: np.ndarray
    reasons: list[str]

    def triangles(self) -> np.ndarray:
        """The polygons cut further, shape (T, 3)."""
        return np.array([(a, b, c) for a, *rest in self.polygons for b, c in itertools.pairwise(rest)])


def make_mesh(sheet: Sheet) -> Mesh:
    """Cut the lattice's triangles where the paths along their sides ended."""
    keys: list[Any] = [*sheet.poses, *sheet.ends]
    index = {key: i for i, key in enumerate(keys)}
    polygons, border, reasons = [], [], []
    for i, j in {(i + a, j + b) for i, j in sheet.poses for a in (-1, 0) for b in (-1, 0)}:
        for triangle in ([(i, j), (i + 1, j), (i, j + 1)], [(i + 1, j), (i + 1, j + 1), (i, j + 1)]):
            for polygon in cut_triangle(sheet, triangle):
                polygons.append([index[key] for key in polygon])
                for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                    if a in sheet.ends and b in sheet.ends:
                        border.append((index[a], index[b]))
                        reasons.append(sheet.ends[a].reason)
    vertices = [*sheet.poses.values(), *(end.pose for end in sheet.ends.values())]
    sites = [*sheet.poses, *(site for site, _ in sheet.ends)]
    return Mesh(vertices, sites, polygons, np.array(border, dtype=int).reshape(-1, 2), reasons)


def cut_triangle(sheet: Sheet, triangle: list[Site]) -> list[list[Any]]:
    """Polygons, as keys of poses and ends, around each group of linked corners of one triangle."""
    before, after = triangle[2:] + triangle[:2], triangle[1:] + triangle[:1]
    around = {}  # corner -> its part of a polygon
    for last, corner, following in zip(before, triangle, after, strict=True):
        if corner in sheet.poses:
            keys = [(corner, last), corner, (corner, following)]
            around[corner] = [key for key in keys if key in sheet.poses or key in sheet.ends]
    groups = [[corner] for corner in around]
    for a, b in zip(triangle, after, strict=True):
        if sheet.linked(a, b):
            joined = [group for group in groups if a in group or b in group]
            groups = [group for group in groups if group not in joined] + [list(itertools.chain(*joined))]
    polygons = [[key for corner in triangle if corner in group for key in around[corner]] for group in groups]
    return [polygon for polygon in polygons if len(polygon) > 2]
