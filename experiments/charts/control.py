"""Control: tracking error against the wall time of a control step, for every controller, horizon and mode.

Two scenes: `lemniscate`, nominal, and `limited`, where the rate limit is active; plant and model are the same robot.
Every file in controllers/ as it is, and those that plan with other horizons, by one linear model a step ("here") and by
models along the plan. With DAQP instead of OSQP: the default along the plan, with every horizon. The nonlinear MPC
(Gauss collocation, IPOPT) and do-mpc (Radau collocation, IPOPT; it is given the true velocity), and where it is
installed Crocoddyl (Box-FDDP on our plant and its linear models, called back in Python; likewise) have the weights of
controllers/nonlinear.toml. The error is the RMS after the first second; a period that was not answered by a solved
problem is a failure, and so are all periods after a run has stopped.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from experiments.charts.points import Key, Row, times
from pcr_mpc import PCRError, SimulationError, Tuning, load_scene, load_tuning, make_controller, simulate
from pcr_mpc.loop.parts.controllers import Controller
from pcr_mpc.loop.scene.scene import Scene

ROOT = Path(__file__).parent.parent.parent
SCENES = {"nominal": "lemniscate", "limited": "limited"}
DO_MPC, CROCODDYL = "do-mpc", "Crocoddyl"
DAQP = "default, DAQP"
FILES = ("default", "slow_motors", "frozen", "robust", "shooting", "nonlinear", "lqr", "pd", "open_loop")
SWEPT = ("default", "frozen", "robust")
_LOST = 20.0  # mm; more is no tracking


@dataclass(frozen=True)
class Plan:
    """How much to measure.

    Attributes
    ----------
    duration : float
        Of a run [s].
    horizons : tuple of int
        Of the linear MPC with the tunings of `SWEPT`.
    nonlinear, peers : tuple of int
        Horizons, besides the filed one; and of the controllers of others.
    """

    duration: float = 6.0
    horizons: tuple[int, ...] = (4, 6, 10, 16, 24)
    nonlinear: tuple[int, ...] = (4, 10, 16)
    peers: tuple[int, ...] = (4, 10, 16)


QUICK = Plan(1.5, (10,), (10,), (10,))


def points(plan: Plan) -> dict[Key, Callable[[], Row]]:
    """Points of the chart, and how to measure each."""
    found: dict[Key, Callable[[], Row]] = {}
    for case, name in SCENES.items():
        scene = load_scene(ROOT / "models" / "scenes" / f"{name}.toml")
        scene = replace(scene, duration=min(scene.duration, plan.duration))
        for file in FILES:
            filed = load_tuning(ROOT / "controllers" / f"{file}.toml")
            for tuning in _variants(file, filed, plan):
                found[case, file, _settings(tuning)] = partial(_measured, scene, tuning)
                if file == "default" and tuning.model.linearise == "along_plan":
                    other = replace(tuning, solver="daqp")
                    found[case, DAQP, _settings(tuning)] = partial(_measured, scene, other)
        for peer in _peers():
            for horizon in plan.peers:
                tuning = replace(load_tuning(ROOT / "controllers" / "nonlinear.toml"), horizon=horizon)
                found[case, peer, _settings(tuning)] = partial(_measured, scene, tuning, peer)
    return found


def _peers() -> list[str]:
    """Those that are installed."""
    return [name for name, package in ((DO_MPC, "do_mpc"), (CROCODDYL, "crocoddyl")) if find_spec(package)]


def _variants(file: str, filed: Tuning, plan: Plan) -> list[Tuning]:
    """The tuning as filed and with other horizons and modes, by mode and horizon."""
    horizons = {filed.horizon, *(plan.nonlinear if filed.law == "nonlinear_mpc" else plan.horizons)}
    if filed.law != "nonlinear_mpc" and file not in SWEPT:
        return [filed]
    modes = ("here", "along_plan") if file in SWEPT else (filed.model.linearise,)
    models = [replace(filed.model, linearise=mode) for mode in modes]
    return [replace(filed, horizon=horizon, model=model) for model in models for horizon in sorted(horizons)]


def filed_settings(file: str) -> str:
    """Settings of a controller as it is filed."""
    return _settings(load_tuning(ROOT / "controllers" / f"{file}.toml"))


def _settings(tuning: Tuning) -> str:
    if tuning.law == "linear_mpc":
        return f"horizon {tuning.horizon}, {tuning.model.linearise}"
    return f"horizon {tuning.horizon}" if tuning.law == "nonlinear_mpc" else "-"


def _measured(scene: Scene, tuning: Tuning, peer: str = "") -> Row:
    failure, controller = "", None
    try:
        controller = _controller(scene, tuning, peer)
        run = simulate(scene.tuned(tuning), scene.make_plant(), controller)
    except SimulationError as error:
        failure, run = str(error), error.run
    except PCRError as error:
        return {"ours": not peer, "success": 0, "attempts": scene.n_periods, "remark": str(error)}
    summary = run.summary()
    row: Row = {"ours": not peer, "success": summary["control_rungs"]["solved"], "attempts": scene.n_periods}
    row |= times(run.control_time[:, 0])
    iterations = np.array(controller.iterations) if peer else run.iterations  # type: ignore[union-attr]
    row |= {"iterations": float(np.median(iterations)), "evaluations": len(run.u)}
    late = 1e3 * run.error[run.t >= min(1.0, run.t[-1] / 2)]
    row |= {"error": float(np.sqrt(np.mean(late**2))), "error_max": float(late.max())}
    if row["error"] > _LOST:
        row["success"] = 0
        failure += f" lost: off by {row['error']:.3g} mm"
    if summary["limit_violations"]:
        failure += f" {summary['limit_violations']} limit violations"
    rungs = [f"{rung}: {count}" for rung, count in summary["control_rungs"].items() if rung != "solved" and count]
    return row | {"remark": " ".join([failure, *rungs]).strip()}


def _controller(scene: Scene, tuning: Tuning, peer: str) -> Controller:
    if peer == DO_MPC:
        from experiments.peers.do_mpc_controller import DoMPC

        return DoMPC(scene, tuning)
    if peer == CROCODDYL:
        from experiments.peers.crocoddyl_controller import Crocoddyl

        return Crocoddyl(scene, tuning)
    return make_controller(scene, tuning)
