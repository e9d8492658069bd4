"""What stands behind the robot, found by another process: its workspace, and the other poses it could be in."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import pickle
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from .. import interrupt
from ..compiled import cache_folder
from ..errors import PCRError
from ..files import write_text
from ..plant.robot import Robot
from ..plant.statics.equilibrium import Equilibrium
from ..plant.statics.free_tip import forward_statics
from ..plant.statics.stability import all_equilibria
from ..study.episodes.parallel import follow_the_parent
from ..study.workspace_sheet import explore, make_mesh
from .frames import centrelines, rounded

_SPACING = 0.085  # of the lattice of tips, in lengths of the shortest rod
_FORMAT = 3  # of a cached workspace
_COARSE = 3  # starts of the search for ghosts in a rod length
_FAR = 0.35  # rad, by which motors may turn until ghosts are looked for anew


class Scenery:
    """Another process that is asked for what takes long, started when it is first asked, one thing at a time."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._ours: Connection | None = None
        self._process: Any = None
        self._over = False

    def workspace(self, pose: Equilibrium) -> dict[str, Any] | None:
        """As `find_workspace`; None if it was ended meanwhile."""
        return self._ask(find_workspace, pose)

    def ghosts(self, robot: Robot, q: np.ndarray, *, anew: bool) -> dict[str, Any] | None:
        """As `find_ghosts`; None if it was ended meanwhile."""
        return self._ask(find_ghosts, robot, q, anew)

    def end(self) -> None:
        """End the process, whatever it is at."""
        self._over = True
        if self._process is not None:
            self._process.terminate()
            self._process.join()

    def _ask(self, task: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any] | None:
        with self._turn:
            if self._over:
                return None
            if self._ours is None:
                context = multiprocessing.get_context("spawn")
                self._ours, theirs = context.Pipe()
                self._process = context.Process(target=_work, args=(theirs,), daemon=True)
                with interrupt.held_back():  # until it follows the parent
                    self._process.start()
                theirs.close()
            try:
                self._ours.send((task, arguments))
                found: dict[str, Any] = self._ours.recv()
            except (EOFError, OSError):
                return None if self._over else {"problem": "the process that looks for it has died"}
            return found


def _work(pipe: Connection) -> None:
    """The other process."""
    follow_the_parent()
    with suppress(AttributeError, OSError):
        os.nice(5)  # what is in real time goes before
    while True:
        try:
            task, arguments = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            found = task(*arguments)
        except Exception as error:  # whatever it is, who waits is told
            found = {"problem": f"{type(error).__name__}: {error}"}
        pipe.send(found)


def find_workspace(pose: Equilibrium) -> dict[str, Any]:
    """Tips that the motors hold, and the edge of them with what ends them there; from the cache if it is in it.

    Returns
    -------
    dict
        ``cells``: polygons of points [m], with the softest stiffness of each [N/m] and whether the motors are within
        their stops there; ``edge``: pairs of points, with the
        reason of each. Or ``problem``, why there is none.
    """
    robot = pose.robot
    if robot.needs_shooting is not None or robot.n_rods != 2:
        return {"problem": f"the workspace is drawn of two plain rods, {robot.name} has others"}
    folder = cache_folder()
    cached = None if folder is None else folder / f"workspace-{_digest(robot, pose.mode)}.json"
    if cached is not None:
        with suppress(OSError, ValueError):
            found = json.loads(cached.read_text(encoding="utf-8"))
            if isinstance(found, dict) and found.get("format") == _FORMAT:
                return found
    sheet = explore(pose, _SPACING * float(robot.lengths.min()), progress=False)
    mesh = make_mesh(sheet)
    beyond = [_beyond_stops(robot, eq.q) for eq in mesh.vertices]
    cells: list[list[Any]] = []
    stops: list[list[Any]] = []
    for polygon in mesh.polygons:
        softest = rounded(np.mean([mesh.vertices[i].stiffness_eigenvalues[0] for i in polygon]), 2)
        corners = [(mesh.vertices[i].p, beyond[i]) for i in polygon]
        for sign, within in ((1.0, True), (-1.0, False)):
            part = _cut([(p, sign * excess) for p, excess in corners])
            if len(part) > 2:
                cells.append([rounded([p for p, _ in part], 4), softest, within])
            ends = [p for p, excess in part if excess == 0.0]
            if within and len(ends) == 2:
                stops.append([rounded(ends, 4), "stops"])
    edge = [
        [rounded([mesh.vertices[a].p, mesh.vertices[b].p], 4), reason]
        for (a, b), reason in zip(mesh.border.tolist(), mesh.reasons, strict=True)
    ]
    made = {"format": _FORMAT, "cells": cells, "edge": edge + stops}
    with suppress(OSError):  # of a full disk
        if cached is not None:
            write_text(cached, json.dumps(made, separators=(",", ":")))
    return made


def _digest(robot: Robot, mode: str) -> str:
    """Of what a workspace rests on."""
    rods = [(rod.base, rod.length, rod.bending_stiffness, rod.angle_limits) for rod in robot.rods]
    about = rods, robot.tip_mass, robot.gravity, mode, _SPACING, _FORMAT
    return hashlib.sha256(pickle.dumps(about)).hexdigest()[:16]


def _beyond_stops(robot: Robot, q: np.ndarray) -> float:
    """How far a motor is beyond its stop, the worst of all, on whatever turn; negative within [rad]."""
    lower, upper = robot.angle_limits.T
    away = (q - (lower + upper) / 2 + np.pi) % (2 * np.pi) - np.pi
    return float((np.abs(away) - (upper - lower) / 2).max())


def _cut(corners: list[tuple[np.ndarray, float]]) -> list[tuple[np.ndarray, float]]:
    """The part of a polygon on which a number that its corners have is not positive; it is 0.0 where it was cut."""
    part: list[tuple[np.ndarray, float]] = []
    for (a, at_a), (b, at_b) in zip(corners, corners[1:] + corners[:1], strict=True):
        if at_a <= 0.0:
            part.append((a, at_a))
        if (at_a <= 0.0) != (at_b <= 0.0) and at_a != 0.0 and at_b != 0.0:
            part.append((a + at_a / (at_a - at_b) * (b - a), 0.0))
    return part


_last: tuple[Robot, np.ndarray, list[Equilibrium]] | None = None  # of this process: ghosts are followed


def find_ghosts(robot: Robot, q: np.ndarray, anew: bool = False) -> dict[str, Any]:
    """Equilibria of the free tip at motor angles q [rad]: the last stable ones are followed, or all are found anew.

    Returns
    -------
    dict
        ``q``, whether they are ``all``, and ``ghosts``: centrelines, tip, mode, energy [J] and whether each is stable.
        Or ``problem``.
    """
    global _last
    try:
        known = _last
        followed = not anew and known is not None and known[0] == robot and bool(np.abs(known[1] - q).max() < _FAR)
        if followed and known is not None:
            found = []
            for old in known[2]:
                with suppress(PCRError):
                    found.append(forward_statics(robot, q, guess=old))
        else:
            found = all_equilibria(robot, q=q, starts=_COARSE)
            _last = robot, np.array(q), [eq for eq in found if eq.stable]
    except (PCRError, ValueError) as error:
        return {"problem": str(error)}
    ghosts = [
        {"rods": centrelines(eq)[0], "p": rounded(eq.p), "mode": eq.mode, "energy": rounded(eq.energy, 5),
         "stable": eq.stable} for eq in found
    ]  # fmt: skip
    return {"q": rounded(q, 4), "all": not followed, "ghosts": ghosts}
