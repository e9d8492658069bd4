"""A tracking controller by Crocoddyl's differential dynamic programming on our plant: another outside reference.

Box-FDDP with the plant's Runge-Kutta step for the dynamics and `linearise` for its derivatives, both called back in
Python, which is most of the time it takes. DDP knows bounds on inputs only: the motors' rates keep theirs in every
period, their changes from one period to the next only in the one that is carried out, and their angles have none.
Crocoddyl comes as a wheel for Linux and macOS (pip install crocoddyl), of more than a gigabyte with what it needs, so
that it is no extra of this project.
"""

from __future__ import annotations

from typing import Any

import crocoddyl
import numpy as np

from pcr_mpc import Equilibrium, InfeasibleError, Plant, Robot, Scene, Tuning, linearise
from pcr_mpc.control.mpc import terminal_weight
from pcr_mpc.loop.demand.feed_forward import feed_forward
from pcr_mpc.loop.parts.assembled import motor_limits
from pcr_mpc.loop.parts.controllers import Decision

_MOST_ITERATIONS = 20
# Of the expected decrease of the cost, in the cost's own unit: a tip that is 1 cm off for one period costs 0.5.
_STOP = 1e-9


class _Period(crocoddyl.ActionModelAbstract):  # type: ignore[misc]
    """One control period: from x = [p, v, q] with the rates u to the next state, and what that costs."""

    def __init__(self, plant: Plant, state: np.ndarray, inputs: np.ndarray) -> None:
        self.plant, self.weights = plant, (state, inputs)
        self.wanted, self.feed_forward = np.zeros(plant.n_states), np.zeros(plant.robot.n_rods)
        crocoddyl.ActionModelAbstract.__init__(self, crocoddyl.StateVector(plant.n_states), plant.robot.n_rods, 0)

    def calc(self, data: Any, x: np.ndarray, u: np.ndarray | None = None) -> None:
        """Next state and cost; at the end of the horizon the cost alone."""
        state, inputs = self.weights
        error = x - self.wanted
        data.cost = error @ state @ error / 2
        data.xnext = x
        if u is not None:
            effort = u - self.feed_forward
            data.cost += effort @ inputs @ effort / 2
            data.xnext = self.plant.step(x, u)

    def calcDiff(self, data: Any, x: np.ndarray, u: np.ndarray | None = None) -> None:
        """Do the same for the derivatives."""
        data.Lxx, inputs = self.weights
        data.Lx = data.Lxx @ (x - self.wanted)
        if u is not None:
            data.Luu = inputs
            data.Lu = inputs @ (u - self.feed_forward)
            model = linearise(self.plant, x, u, self.plant.dt)
            data.Fx, data.Fu = model.A, model.B


class Crocoddyl:
    """Tracks a scene's reference; takes the measured state for the true one and knows neither delay nor load.

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
        One entry for each step.
    """

    name = "Crocoddyl"

    def __init__(self, scene: Scene, tuning: Tuning, robot: Robot | None = None) -> None:
        if scene.trajectory is None:
            raise ValueError(f"scene {scene.name} has no reference to track")
        self.robot = robot or scene.robot
        self._scene, self._tuning = scene, tuning
        self._limits = motor_limits(self.robot, scene.period)
        self.iterations: list[int] = []

    def start(self, pose: Equilibrium) -> None:
        """Get ready: the robot rests in ``pose``."""
        tuning, n = self._tuning, self.robot.n_rods
        self._reference = feed_forward(self._scene, self.robot, pose, tuning.horizon)
        x = np.concatenate([pose.p, np.zeros(2), pose.q])
        plants = [Plant(self.robot, integrator="rk4", dt=self._scene.period) for _ in range(tuning.horizon + 1)]
        for plant in plants:
            plant.reset(x, pose)
        stage = np.diag([tuning.position_weight] * 2 + [tuning.velocity_weight] * 2 + [tuning.angle_weight] * n)
        effort = tuning.input_weight * np.eye(n)
        last = terminal_weight(linearise(plants[0], x, np.zeros(n), self._scene.period), tuning)
        self._periods = [_Period(plant, stage, effort) for plant in plants[:-1]]
        self._end = _Period(plants[-1], last, effort)
        self._problem = crocoddyl.ShootingProblem(x, self._periods, self._end)
        self._solver = crocoddyl.SolverBoxFDDP(self._problem)
        self._solver.th_stop = _STOP
        # As for the other controllers, a first step before the clock runs.
        self._u, self._plan = np.zeros(n), [np.zeros(n)] * tuning.horizon
        self.step(0, x)
        self._u, self._plan = np.zeros(n), [np.zeros(n)] * tuning.horizon
        self.iterations.clear()

    def step(self, k: int, x: np.ndarray) -> Decision:
        """Decide on period k from the measured state.

        Raises
        ------
        InfeasibleError
            The solver did not converge; there is no fall-back.
        """
        states, inputs, limits = self._reference.states[k:], self._reference.inputs[k:], self._limits
        for j, period in enumerate([*self._periods, self._end]):
            period.wanted = states[j]
            period.feed_forward = inputs[min(j, len(inputs) - 1)]
            period.u_lb, period.u_ub = np.full(period.nu, -limits.rate), np.full(period.nu, limits.rate)
        first = self._periods[0]
        first.u_lb = np.maximum(first.u_lb, self._u - limits.rate_change)
        first.u_ub = np.minimum(first.u_ub, self._u + limits.rate_change)
        self._problem.x0 = x
        guess = [np.clip(u, p.u_lb, p.u_ub) for u, p in zip(self._plan, self._periods, strict=True)]
        done = self._solver.solve(list(self._problem.rollout(guess)), guess, _MOST_ITERATIONS, True)
        self.iterations.append(int(self._solver.iter))
        if not done:
            raise InfeasibleError(
                f"Crocoddyl did not converge in period {k}: it stopped at {self._solver.stop:.1e} after "
                f"{self._solver.iter} iterations (wanted {_STOP:.0e}); relax limits or the reference",
                status="not converged",
                limit=None,
            )
        rates = [np.array(u) for u in self._solver.us]
        self._u, self._plan = rates[0], [*rates[1:], rates[-1]]
        return Decision(rates[0])
