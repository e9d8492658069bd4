"""Time steps of the plant: one rigid-body-like equation for every kind of inertia.

With the motors turning at the rates u, held over a step, q = q0 + u t and Lagrange's equations for the tip are

    pi' = -F(p, q) + f_ext - c v + d/dp (w' M w / 2),    p' = v,    pi = M_pp v + M_pq u,    w = [v, u].

The momentum pi is what the schemes advance: it does not jump where the rates do. At the ends of a step the motors are
taken to stand still, and the state's v is M_pp^-1 pi; the tip itself moves with v - M_pp^-1 M_pq u in between. For
massless rods M = diag(m, m, 0, ...), and v is the velocity of the tip.

The schemes are symplectic Euler and Stoermer-Verlet for a Hamiltonian that is not separable: where a momentum is
implicit, M and its derivatives are at hand, and a fixed number of iterations of a map that contracts like
dt |v| / L times the rods' share of the mass solves it to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import casadi as ca
import numpy as np

from ...buffered import BufferedFunction, graph_cache
from ..robot import Robot
from .mass_matrix import MassMatrix

# Each gains four digits or more.
_ITERATIONS = 3
# Where the next stage of RK4 is, and how much this one counts, in steps.
RK4_STAGES = ((1 / 2, 1 / 6), (1 / 2, 1 / 3), (1.0, 1 / 3), (0.0, 1 / 6))


class Weighed(Protocol):
    """What the schemes ask of a plant."""

    @property
    def robot(self) -> Robot:
        """The robot."""

    @property
    def dt(self) -> float:
        """Step [s]."""

    def mass(self, p: np.ndarray, q: np.ndarray) -> MassMatrix:
        """Mass matrix at (p, q) and its slopes."""

    def force_and_mass(self, p: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, MassMatrix]:
        """Force of the rods at (p, q), and `mass`."""


class _Symbols:
    """What all graphs share: mass matrix, its derivatives, force without drag, rates, and the numbers [c, dt]."""

    def __init__(self, n: int) -> None:
        self.n = n
        self.mass, self.slopes = ca.SX.sym("M", 2 + n, 2 + n), ca.SX.sym("dM", (2 + n) ** 2, 2 + n)
        self.force, self.u, self.numbers = ca.SX.sym("F", 2), ca.SX.sym("u", n), ca.SX.sym("numbers", 2)
        self.drag, self.dt = self.numbers[0], self.numbers[1]

    @property
    def inputs(self) -> list[Any]:
        return [self.mass, self.slopes, self.force, self.u, self.numbers]

    def velocity(self, momentum: Any, mass: Any = None, drag: Any = 0) -> Any:
        """Velocity v of the tip with (M_pp + drag) v + M_pq u = momentum."""
        mass = self.mass if mass is None else mass
        a, b, d = mass[0, 0] + drag, mass[0, 1], mass[1, 1] + drag
        right = momentum - mass[:2, 2:] @ self.u
        return ca.vertcat(d * right[0] - b * right[1], a * right[1] - b * right[0]) / (a * d - b * b)

    def coriolis(self, v: Any) -> Any:
        """d/dp of the kinetic energy at given velocities."""
        w = ca.vertcat(v, self.u)
        # Not by way of w w', which overflows for velocities that a massless rod would bear.
        slopes = [ca.reshape(self.slopes[:, k], 2 + self.n, 2 + self.n) for k in (0, 1)]
        return ca.vertcat(*(ca.dot(slope @ w, w) / 2 for slope in slopes))

    def at_rest(self, momentum: Any) -> Any:
        """Velocity v of the tip with the motors at rest: M_pp v = momentum."""
        return self.velocity(momentum + self.mass[:2, 2:] @ self.u)

    def function(self, name: str, others: list[Any], results: list[Any]) -> Any:
        return ca.Function(name, [*self.inputs, *others], results, {"cse": True})


@graph_cache()
def stop_graph(n: int) -> Any:
    """Build (known, momentum) -> v."""
    s, momentum = _Symbols(n), ca.SX.sym("pi", 2)
    return s.function("stop", [momentum], [s.at_rest(momentum)])


@graph_cache()
def euler_graph(n: int) -> Any:
    """Build (known, x) -> p, q, momentum: a step of symplectic Euler."""
    s, x = _Symbols(n), ca.SX.sym("x", 4 + n)
    start = s.mass[:2, :2] @ x[2:4]
    v = s.velocity(start)
    pushed = start + s.dt * (s.force - s.drag * v)
    for _ in range(_ITERATIONS):
        momentum = pushed + s.dt * s.coriolis(v)
        v = s.velocity(momentum)
    return s.function("euler", [x], [x[:2] + s.dt * v, x[4:] + s.dt * s.u, momentum])


@graph_cache()
def first_half_graph(n: int) -> Any:
    """Build (known, x) -> p, q, momentum before the second kick."""
    s, x = _Symbols(n), ca.SX.sym("x", 4 + n)
    start, half = s.mass[:2, :2] @ x[2:4], s.dt / 2
    v = s.velocity(start)
    for _ in range(_ITERATIONS):
        v = s.velocity(start + half * (s.force + s.coriolis(v)), drag=half * s.drag)
    momentum = s.mass[:2, :2] @ v + s.mass[:2, 2:] @ s.u
    drift = s.dt * v
    for _ in range(_ITERATIONS):
        turned = s.mass + ca.reshape(s.slopes @ ca.vertcat(drift, s.dt * s.u), 2 + n, 2 + n)
        drift = half * (v + s.velocity(momentum, turned))
    return s.function("first_half", [x], [x[:2] + drift, x[4:] + s.dt * s.u, momentum])


@graph_cache()
def second_half_graph(n: int) -> Any:
    """Build (known, momentum) -> v at the end."""
    s, momentum = _Symbols(n), ca.SX.sym("pi", 2)
    v = s.velocity(momentum)
    after = momentum + s.dt / 2 * (s.force + s.coriolis(v) - s.drag * v)
    return s.function("second_half", [momentum], [s.at_rest(after)])


@graph_cache()
def stage_graph(n: int) -> Any:
    """Build (known, y, start, sum, [ahead, weight]) -> start + ahead y', sum + weight y' with y = [p, pi, q]."""
    s, (y, start, total) = _Symbols(n), (ca.SX.sym(name, 4 + n) for name in ("y", "start", "sum"))
    factors = ca.SX.sym("factors", 2)
    v = s.velocity(y[2:4])
    slope = ca.vertcat(v, s.force + s.coriolis(v) - s.drag * v, s.u)
    return s.function("stage", [y, start, total, factors], [start + factors[0] * slope, total + factors[1] * slope])


class _Graph(BufferedFunction):
    """One of the graphs above, with what it shares with the others written into its inputs by `load`."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        self._held: object = None

    def load(self, plant: Weighed, p: np.ndarray, q: np.ndarray, rate: np.ndarray, f_ext: np.ndarray) -> None:
        """Write what is known at (p, q)."""
        inputs = self.inputs
        force, mass = plant.force_and_mass(p, q)
        inputs[2][:] = f_ext - force
        inputs[3][:] = rate
        inputs[4][:] = plant.robot.drag, plant.dt
        self.hold(mass)

    def hold(self, mass: tuple[np.ndarray, np.ndarray]) -> None:
        """Write the mass matrix, unless it is the one that is there."""
        if mass is not self._held:
            self.inputs[0][:], self.inputs[1][:] = mass
            self._held = mass


class SemiImplicitEuler:
    """Symplectic Euler: the momentum with the force at the start, then the position; first order.

    One force a step.
    """

    def __init__(self, n: int) -> None:
        self._step, self._stop = _Graph(euler_graph(n)), _Graph(stop_graph(n))

    def __call__(self, plant: Weighed, x: np.ndarray, rate: np.ndarray, f_ext: np.ndarray) -> np.ndarray:
        """Advance by one step."""
        step, stop = self._step, self._stop
        step.load(plant, x[:2], x[4:], rate, f_ext)
        step.inputs[5][:] = x
        step()
        p, q, stop.inputs[5][:] = step.outputs
        stop.hold(plant.mass(p, q))
        stop()
        return np.concatenate([p, stop.outputs[0], q])


class VelocityVerlet:
    """Stoermer-Verlet: half a kick, drift, half a kick; second order.

    Drag is implicit in the first kick and explicit in the second, which makes each the adjoint of the other. The drift
    needs M at its end, which it extrapolates; the third-order error in the position is a rod's share of the mass.
    The force at the end is the next step's first: one force a step.
    """

    def __init__(self, n: int) -> None:
        self._first, self._second = _Graph(first_half_graph(n)), _Graph(second_half_graph(n))

    def __call__(self, plant: Weighed, x: np.ndarray, rate: np.ndarray, f_ext: np.ndarray) -> np.ndarray:
        """Advance by one step."""
        first, second = self._first, self._second
        first.load(plant, x[:2], x[4:], rate, f_ext)
        first.inputs[5][:] = x
        first()
        p, q, second.inputs[5][:] = first.outputs
        second.load(plant, p, q, rate, f_ext)
        second()
        return np.concatenate([p, second.outputs[0], q])


class RK4:
    """The classical scheme on [p, pi, q]; fourth order, four forces a step."""

    def __init__(self, n: int) -> None:
        self._stage, self._stop = _Graph(stage_graph(n)), _Graph(stop_graph(n))

    def __call__(self, plant: Weighed, x: np.ndarray, rate: np.ndarray, f_ext: np.ndarray) -> np.ndarray:
        """Advance by one step."""
        stage, stop, dt = self._stage, self._stop, plant.dt
        y, start, total, factors = stage.inputs[5:]
        ahead, done = stage.outputs
        y[:] = x
        y[2:4] = plant.mass(x[:2], x[4:])[0][:2, :2] @ x[2:4]
        start[:] = total[:] = y
        for fraction, weight in RK4_STAGES:
            stage.load(plant, y[:2], y[4:], rate, f_ext)
            factors[:] = dt * fraction, dt * weight
            stage()
            y[:], total[:] = ahead, done
        end = total.copy()
        stop.hold(plant.mass(end[:2], end[4:]))
        stop.inputs[5][:] = end[2:4]
        stop()
        end[2:4] = stop.outputs[0]
        return end


INTEGRATORS: dict[str, Callable[[int], Any]] = {
    "semi_implicit_euler": SemiImplicitEuler,
    "velocity_verlet": VelocityVerlet,
    "rk4": RK4,
}
