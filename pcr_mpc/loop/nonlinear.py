"""The nonlinear MPC of a robot: equations of motion in closed form, on the branch of a pose."""

from __future__ import annotations

from ..control.nonlinear_mpc import NonlinearMPC
from ..control.tuning import Limits, Tuning
from ..plant.equilibrium import Equilibrium
from ..plant.robot import Robot
from ..plant.symbolic import rod_unknowns, symbolic_dynamics


def make_nonlinear_mpc(
    robot: Robot, pose: Equilibrium, tuning: Tuning, limits: Limits, *, points: int = 3, max_iterations: int = 100
) -> NonlinearMPC:
    """Build the controller for a robot, as it believes it to be, that starts in a pose.

    Parameters
    ----------
    robot : Robot
    pose : Equilibrium
        Says to which side each rod turns at its tip; the controller's model keeps that.
    tuning, limits, points, max_iterations
        See `NonlinearMPC`.
    """
    hands, algebraic = rod_unknowns(robot, pose)
    dynamics = symbolic_dynamics(robot, hands)
    return NonlinearMPC(tuning, limits, dynamics, algebraic, points=points, max_iterations=max_iterations)
