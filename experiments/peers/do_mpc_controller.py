"""A tracking controller by do-mpc on the same equations, weights and limits: an outside reference."""

from __future__ import annotations

import time
import warnings
from typing import Any

import casadi as ca
import numpy as np

from pcr_mpc import Equilibrium, InfeasibleError, Plant, Robot, Scene, Tuning, linearise
from pcr_mpc.control.mpc import terminal_weight
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.loop.parts.assembled import motor_limits
from pcr_mpc.loop.parts.controllers import Decision
from pcr_mpc.plant.statics.symbolic import rod_unknowns, symbolic_dynamics

with warnings.catch_warnings():
    warnings.simplefilter("ignore", UserWarning)  # which of its optional features are not installed
    import do_mpc

# do-mpc collocates at Radau points, of order 2 deg - 1.
_DEGREE = 3


class DoMPC:
    """Tracks a scene's reference with do-mpc, as do-mpc comes: Radau collocation, IPOPT from the last solution.

    It takes the measured state for the true one (do-mpc's estimators are not used) and knows neither delay nor load.

    Parameters
    ----------
    scene : Scene
        Reference, period and limits.
    tuning : Tuning
        Horizon and weights.
    robot : Robot, optional
        What the controller believes the robot to be; by default the scene's.

    Attributes
    ----------
    iterations : list of int
        Of IPOPT, one for each step.
    solve_times : list of float
        Of do-mpc's step, one for each [s].
    """

    name = "do-mpc"

    def __init__(self, scene: Scene, tuning: Tuning, robot: Robot | None = None) -> None:
        if scene.trajectory is None:
            raise ValueError(f"scene {scene.name} has no reference to track")
        self.robot = robot or scene.robot
        self._scene, self._tuning = scene, tuning
        self.iterations: list[int] = []
        self.solve_times: list[float] = []

    def start(self, pose: Equilibrium) -> None:
        """Get ready: the robot rests in ``pose``."""
        scene, horizon = self._scene, self._tuning.horizon
        self._reference = feed_forward(scene, self.robot, pose, horizon)
        x, rest = np.concatenate([pose.p, np.zeros(2), pose.q]), np.zeros(self.robot.n_rods)
        plant = Plant(self.robot)
        plant.reset(x, pose)
        hands, algebraic = rod_unknowns(self.robot, pose)
        weight = terminal_weight(linearise(plant, x, rest, scene.period), self._tuning)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", FutureWarning)  # casadi 3.8 about NumPy functions that do-mpc calls
            model = _model(symbolic_dynamics(self.robot, hands), self.robot.n_rods)
            self._mpc = self._make_mpc(model, weight)
        self._mpc.x0, self._mpc.u0 = x, rest
        self._mpc.z0 = algebraic(pose.p[None], pose.q[None])[0]
        self._mpc.set_initial_guess()
        # As for the other controllers, a first step before the clock runs.
        self.step(0, x)
        self._mpc.reset_history()
        self._mpc.x0, self._mpc.u0 = x, rest
        self._mpc.set_initial_guess()
        self.iterations.clear()
        self.solve_times.clear()

    def step(self, k: int, x: np.ndarray) -> Decision:
        """Decide on period k from the measured state.

        Raises
        ------
        InfeasibleError
            IPOPT did not succeed; there is no fall-back.
        """
        began = time.perf_counter()
        u = self._mpc.make_step(x[:, None]).ravel()
        self.solve_times.append(time.perf_counter() - began)
        stats = self._mpc.solver_stats
        self.iterations.append(int(stats["iter_count"]))
        if stats["return_status"] != "Solve_Succeeded":
            raise InfeasibleError(
                f"do-mpc's NLP was not solved in period {k}: {stats['return_status']} after {stats['iter_count']} "
                "iterations; relax limits or the reference",
                status=stats["return_status"],
                limit=None,
            )
        return Decision(u)

    def _make_mpc(self, model: Any, terminal: np.ndarray) -> Any:
        tuning, limits, n = self._tuning, motor_limits(self._scene.robot, self._scene.period), self.robot.n_rods
        mpc = do_mpc.controller.MPC(model)
        settings = mpc.settings
        settings.n_horizon, settings.t_step = tuning.horizon, self._scene.period
        settings.collocation_deg = _DEGREE
        # What it would store of every step is of no use here.
        settings.store_lagr_multiplier, settings.store_solver_stats = False, []
        settings.supress_ipopt_output()
        settings.nlpsol_opts["show_eval_warnings"] = False  # of trial points where the model is NaN
        settings.nlpsol_opts["ipopt.bound_relax_factor"] = 0.0  # limits are hard here
        error = model.x.cat - model.tvp["state"]
        effort = model.u["rate"] - model.tvp["input"]
        stage = ca.diag([tuning.position_weight] * 2 + [tuning.velocity_weight] * 2 + [tuning.angle_weight] * n)
        mpc.set_objective(
            mterm=ca.bilin(ca.DM(terminal), error, error) / 2,
            lterm=(ca.bilin(stage, error, error) + tuning.input_weight * ca.sumsqr(effort)) / 2,
        )
        mpc.set_rterm(rate=0.0)
        mpc.bounds["lower", "_u", "rate"], mpc.bounds["upper", "_u", "rate"] = -limits.rate, limits.rate
        for side, angles in (("lower", limits.angle_lower), ("upper", limits.angle_upper)):
            mpc.bounds[side, "_x", "q"] = angles
            mpc.terminal_bounds[side, "q"] = angles
        reference = mpc.get_tvp_template()

        def window(t: Any) -> Any:
            k, inputs = round(float(np.squeeze(t)) / self._scene.period), self._reference.inputs
            for j in range(tuning.horizon + 1):
                reference["_tvp", j, "state"] = self._reference.states[k + j]
                # One input fewer than states: the last one has no weight.
                reference["_tvp", j, "input"] = inputs[min(k + j, len(inputs) - 1)]
            return reference

        mpc.set_tvp_fun(window)
        mpc.prepare_nlp()
        # do-mpc knows weights on the change of the inputs, but no limits.
        before = mpc.opt_p["_u_prev"]
        for j in range(tuning.horizon):
            mpc.nlp_cons.append(mpc.opt_x["_u", j, 0] - before)
            mpc.nlp_cons_lb.append(np.full((n, 1), -limits.rate_change))
            mpc.nlp_cons_ub.append(np.full((n, 1), limits.rate_change))
            before = mpc.opt_x["_u", j, 0]
        mpc.create_nlp()
        return mpc


def _model(dynamics: Any, n: int) -> Any:
    """Build do-mpc's model: x = [p, v, q] with motor rates as inputs, the rods' unknowns algebraic."""
    model = do_mpc.model.Model("continuous", "SX")
    p, v, q = (model.set_variable("_x", name, size) for name, size in (("p", 2), ("v", 2), ("q", n)))
    z = model.set_variable("_z", "z", 2 * n)
    rate = model.set_variable("_u", "rate", n)
    model.set_variable("_tvp", "state", 4 + n)
    model.set_variable("_tvp", "input", n)
    acceleration, residual, _ = dynamics(p, v, q, z, ca.DM.zeros(2))
    model.set_rhs("p", v)
    model.set_rhs("v", acceleration)
    model.set_rhs("q", rate)
    model.set_alg("statics", residual)
    model.setup()
    return model
