"""What was played, as a run that reports and identification read."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from ...errors import PCRError
from ...loop.parts.controllers import Decision
from ...loop.run.record import Recorded, versions
from ...loop.run.run import Run
from ...loop.scene.scene import Scene
from ...loop.scene.settings import Payload
from ...plant.robot import Robot
from .pilot import Pilot
from .rig import Rig, snapping

LONGEST = 120.0  # s


class Recorder:
    """Keeps what happens from the beginning of a control period on.

    Parameters
    ----------
    scene : Scene
        As it is then.
    rig : Rig
    target : ndarray, shape (2,), or None
        Where the tip is to be then [m].
    seed : int
        Of the measurement noise.
    """

    def __init__(self, scene: Scene, rig: Rig, target: np.ndarray | None, seed: int) -> None:
        self._scene, self._seed = scene, seed
        self._pose = rig.equilibrium()
        self._velocity = rig.x[2:4].copy()
        self._states: list[np.ndarray] = [rig.x.copy()]
        self._applied: list[np.ndarray] = []
        self._reference = [_known(target)]
        self._measured: list[np.ndarray] = []
        self._decisions: list[Decision] = []
        self._payloads: list[float] = []
        self._events: list[dict[str, Any]] = []
        self._began: float | None = None
        self._rungs = rig.plant.rungs
        self._pulled = False
        self.run: Run | None = None

    @property
    def full(self) -> bool:
        """Whether there is no room for more."""
        return len(self._decisions) * self._scene.period >= LONGEST

    @property
    def duration(self) -> float:
        """Recorded so far [s]."""
        return len(self._applied) * self._scene.plant.dt

    def tell(self, t: float, kind: str, message: str) -> None:
        """Note an event at a time of the session [s]."""
        began = t if self._began is None else self._began
        self._events.append({"t": max(t - began, 0.0), "kind": kind, "message": message})

    def decide(self, measured: np.ndarray, decision: Decision) -> None:
        """Keep a control period, which begins."""
        self._measured.append(measured)
        self._decisions.append(decision)

    def step(self, rig: Rig, t: float, target: np.ndarray | None) -> None:
        """Keep a step of the plant, which ended at time t of the session [s]."""
        if self._began is None:
            self._began = t - rig.dt
        self._states.append(rig.x.copy())
        self._applied.append(rig.applied.copy())
        self._reference.append(_known(target))
        self._payloads.append(rig.plant.payload)
        if rig.force.any() and not self._pulled:
            self.tell(t, "warning", "the tip was pulled by hand: that force is no part of the record")
        self._pulled = bool(rig.force.any())

    def ended(self, pilot: Pilot, rig: Rig) -> Recorder:
        """Make the run of what there is in whole periods.

        Raises
        ------
        PCRError
            There is not one.
        """
        scene, n = self._scene, self._scene.robot.n_rods
        per = round(scene.period / scene.plant.dt)
        periods = min(len(self._decisions), len(self._applied) // per)
        if periods < 1:
            raise PCRError("nothing was recorded: not one whole control period has passed")
        steps = periods * per
        t = scene.plant.dt * np.arange(steps + 1)
        x, applied = np.array(self._states[: steps + 1]), np.array(self._applied[:steps])
        reference = np.array(self._reference[: steps + 1])
        tracked = bool(np.isfinite(reference).all())
        decisions = self._decisions[:periods]
        own = getattr(pilot.controller, "robot", None)
        self.run = Run(
            scene=replace(
                scene, duration=periods * scene.period, start_tip=None, start_mode=None,
                start_motors=tuple(self._pose.q.tolist()), start_velocity=tuple(self._velocity.tolist()),
                trajectory=_recorded(t, reference) if tracked else None, payload=self._payload(steps),
                plant=snapping(scene), finding=None,
            ),
            controller=pilot.name, plant=f"{rig.plant.method}, {rig.plant.integrator}, dt = {1e3 * rig.dt:g} ms",
            seed=self._seed, pose=self._pose, dt=scene.plant.dt, t=t, x=x,
            reference=reference if tracked else np.full_like(reference, np.nan),
            u=np.array([decision.u for decision in decisions]),
            plant_time=np.full(steps, np.nan), control_time=_times(decisions),
            iterations=np.array([0 if each.plan is None else each.plan.iterations for each in decisions]),
            active_limits=dict(Counter(kind for each in decisions if each.plan for kind in each.plan.active)),
            slack=_slack(decisions), rungs=_since(self._rungs, rig.plant.rungs),
            events=[event for event in self._events if event["t"] <= t[-1]], rung=scene.plant,
            measured=np.array(self._measured[:periods]),
            estimate=_or_nan([each.estimate for each in decisions], 4 + n),
            estimated_force=_or_nan([each.force for each in decisions], 2), applied=applied,
            decision_time=np.zeros(periods), tuning=getattr(pilot.controller, "tuning", None),
            believed=own if isinstance(own, Robot) else None, versions=versions(),
        )  # fmt: skip
        return self

    def _payload(self, steps: int) -> Payload | None:
        """What was carried, if that is one thing picked up once; else it is told."""
        carried, dt = np.array(self._payloads[:steps]), self._scene.plant.dt
        if not carried.any():
            return None
        masses = np.unique(carried[carried > 0])
        held = np.flatnonzero(carried)
        if len(masses) == 1 and len(held) == held[-1] - held[0] + 1:
            return Payload(float(masses[0]), dt * float(held[0]), dt * float(held[-1] + 1))
        self._events.append({"t": 0.0, "kind": "warning", "message": "the load was changed more than once: the record "
                             f"does not have it; it was {carried.min():.4g} to {carried.max():.4g} kg"})  # fmt: skip
        return None


def _known(target: np.ndarray | None) -> np.ndarray:
    return np.full(2, np.nan) if target is None else target


def _recorded(t: np.ndarray, reference: np.ndarray) -> Recorded:
    velocity = np.gradient(reference, t, axis=0)
    return Recorded(t, np.stack([reference, velocity, np.gradient(velocity, t, axis=0)], axis=1))


def _times(decisions: list[Decision]) -> np.ndarray:
    """Columns as of `Run`; what was not measured is zero."""
    found = np.zeros((len(decisions), 6))
    for row, decision in zip(found, decisions, strict=True):
        row[1] = decision.linearise_time
        if decision.plan is not None:
            row[2:5] = decision.plan.update_time, decision.plan.solve_time, decision.plan.solver_time
        row[0] = row[1:4].sum()
    return found


def _slack(decisions: list[Decision]) -> dict[str, float]:
    most: dict[str, float] = {}
    for decision in decisions:
        for kind, amount in ({} if decision.plan is None else decision.plan.slack).items():
            most[kind] = max(amount, most.get(kind, 0.0))
    return most


def _since(before: dict[str, int], after: dict[str, int]) -> dict[str, int]:
    return {rung: max(count - before.get(rung, 0), 0) for rung, count in after.items()}


def _or_nan(given: list[np.ndarray | None], size: int) -> np.ndarray:
    return np.array([np.full(size, np.nan) if each is None else each for each in given])
