"""Pictures of a run and of an equilibrium."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import FuncAnimation, PillowWriter
from tqdm import tqdm

from .. import interrupt
from ..files import replacing
from ..loop.run.run import Run
from ..plant.motion.plant import Plant
from ..plant.statics.equilibrium import Equilibrium
from .style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, RODS, plt, save_figure
from .tables import without_rounding

_FRAMES_PER_SECOND = 20
_LONGEST_ANIMATION = 4.0  # s of the run shown
_USUAL_TIMES = (5.0, 2e4)  # us, of a histogram; wider where a step took less or more
_LEAST_SHARE = 0.02  # of an error's samples that may lie below its logarithmic axis


def draw_robot(axes: Any, eq: Equilibrium, alpha: float = 1.0) -> None:
    """Draw rods, motors and the joint."""
    for i, line in enumerate(eq.shape(60)):
        axes.plot(*line.T, color=RODS[i % len(RODS)], lw=2.2, alpha=alpha, solid_capstyle="round", zorder=3)
        axes.plot(*line[0], "s", color="black", ms=7, zorder=4)
    axes.plot(*eq.p, "o", color="black", ms=7, alpha=alpha, zorder=5)


def frame(axes: Any, shapes: np.ndarray, margin: float = 0.03) -> None:
    """Set equal axes in metres around centrelines of shape (..., 2)."""
    points = shapes.reshape(-1, 2)
    low, high = points.min(axis=0) - margin, points.max(axis=0) + margin
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="x [m]", ylabel="y [m]")
    axes.set_aspect("equal")
    axes.locator_params(nbins=6)  # or the numbers run into each other


def plot_equilibrium(eq: Equilibrium, path: Path) -> None:
    """Draw one equilibrium with its figures.

    Parameters
    ----------
    eq : Equilibrium
    path : Path
        Of the picture; its ending says which kind.
    """
    figure, axes = plt.subplots(figsize=(6, 5))
    draw_robot(axes, eq)
    frame(axes, eq.shape(60))
    verdict, force = "stable" if eq.stable else "unstable", without_rounding(eq.force, eq.robot.force_scale)
    axes.set_title(
        f"{eq.robot.name}: mode {eq.mode}, {verdict}\nF = ({force[0]:.3g}, {force[1]:.3g}) N, U = {eq.energy:.4g} J"
    )
    save_figure(figure, path)


def plot_equilibria(found: list[Equilibrium], path: Path) -> None:
    """Draw all equilibria side by side, in the order of their energies.

    Parameters
    ----------
    found : list of Equilibrium
    path : Path
        Of the picture; its ending says which kind.
    """
    columns = min(4, len(found))
    rows = -(-len(found) // columns)
    figure, panels = plt.subplots(
        rows, columns, figsize=(3.2 * columns, 3.2 * rows), squeeze=False, layout="constrained"
    )
    everything = np.concatenate([eq.shape(60).reshape(-1, 2) for eq in found])
    for axes, eq in zip(panels.flat, found, strict=False):
        draw_robot(axes, eq, alpha=1.0 if eq.stable else 0.5)
        frame(axes, everything)
        axes.label_outer()
        axes.set_title(f"{eq.mode}, {'stable' if eq.stable else 'unstable'}, {eq.energy:.3f} J", fontsize=9,
                       color="black" if eq.stable else RED)  # fmt: skip
    for axes in panels.flat[len(found) :]:
        axes.set_visible(False)
    save_figure(figure, path)


def poses_along(run: Run, indices: np.ndarray) -> list[Equilibrium]:
    """Rods at some of the run's states, followed from one to the next."""
    plant = Plant(run.scene.robot, dt=run.dt)
    plant.reset(run.x[0], run.pose)
    wanted = set(indices.tolist())
    # The branch is followed through every tenth state, not jumped to.
    found = {}
    for k in range(len(run.x)):
        interrupt.check()
        if k in wanted or k % 10 == 0:
            eq = plant.equilibrium(run.x[k]) if k in wanted else None
            if eq is None:
                plant.force(run.x[k, :2], run.x[k, 4:])
            else:
                found[k] = eq
    return [found[k] for k in indices.tolist()]


def plot_run(run: Run, path: Path) -> None:
    """Draw path, error, inputs with limits, and step times.

    Parameters
    ----------
    run : Run
    path : Path
        Of the picture; its ending says which kind.
    """
    figure, ((path_axes, error_axes), (input_axes, time_axes)) = plt.subplots(2, 2, figsize=(11, 8))
    tracked = bool(np.isfinite(run.reference).all())
    summary = run.summary()

    shown = poses_along(run, np.unique(np.linspace(0, len(run.t) - 1, 4).astype(int)))
    for eq in shown[1:]:
        draw_robot(path_axes, eq, alpha=0.25)
    draw_robot(path_axes, shown[0])
    if tracked:
        path_axes.plot(*run.reference.T, color=GREY, lw=4, alpha=0.5, label="reference", zorder=6)
    path_axes.plot(*run.x[:, :2].T, color=RED, lw=1.2, label="tip", zorder=7)
    frame(path_axes, np.concatenate([run.x[:, :2], *(eq.shape(60).reshape(-1, 2) for eq in shown)]))
    path_axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2)  # below the rods, wherever they are
    path_axes.set_title(f"{run.scene.name}: robot and path of the tip")

    if tracked:
        plot_error(error_axes, run.t, 1e3 * run.error)
        late = summary["rms_after_1s_mm"]
        if late is not None:
            error_axes.axhline(late, color=ORANGE, ls="--", label=f"RMS after 1 s: {late:.2g} mm")
            error_axes.legend(loc="best")
        error_axes.set(ylabel="distance from the reference [mm]", title="Tracking error")
    else:
        for axis, (name, colour) in enumerate((("x", BLUE), ("y", ORANGE))):
            error_axes.plot(run.t, 1e3 * (run.x[:, axis] - run.x[0, axis]), color=colour, label=name)
        error_axes.set(ylabel="tip displacement [mm]", title="Free motion")
        error_axes.legend(loc="best")
    error_axes.set_xlabel("t [s]")

    periods = run.scene.period * np.arange(len(run.u))
    for i, rates in enumerate(run.u.T):
        input_axes.step(periods, rates, where="post", color=RODS[i % len(RODS)], lw=1.2, label=f"motor {i} (q{i})")
    limit = run.scene.robot.rate_limit
    highest = max(limit, float(np.abs(run.u).max(initial=0.0)))
    for sign in (-1, 1):
        input_axes.axhline(sign * limit, color=RED, ls=":", label="limit" if sign > 0 else None)
    input_axes.set(xlabel="t [s]", ylabel="motor rate [rad/s]", title="Inputs, as decided",
                   ylim=(-1.1 * highest, 1.1 * highest))  # fmt: skip
    input_axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=3)

    plot_times(
        time_axes,
        {"plant step": (1e6 * run.plant_time, BLUE), "control step": (1e6 * run.control_time[:, 0], GREEN)},
        {
            "plant step": (summary["plant_budget_us"], BLUE),
            "control period": (summary["control_budget_us"], PURPLE),
        },
    )
    figure.tight_layout()
    save_figure(figure, path)


def plot_error(axes: Any, t: np.ndarray, error_mm: np.ndarray) -> None:
    """Draw an error on a logarithmic axis that begins where the error does, but for its first zeros."""
    positive = error_mm[error_mm > 0]
    axes.plot(t, np.where(error_mm > 0, error_mm, np.nan), color=BLUE, lw=1.0)
    if len(positive):
        lowest = 10.0 ** np.floor(np.log10(np.quantile(positive, _LEAST_SHARE)))
        axes.set_yscale("log")
        axes.set_ylim(lowest, 2.0 * positive.max())


def plot_times(axes: Any, samples: dict[str, tuple[np.ndarray, str]], budgets: dict[str, tuple[float, str]]) -> None:
    """Histogram of step times on a logarithmic axis, with budgets as lines."""
    shown = {name: pair for name, pair in samples.items() if len(pair[0]) and pair[0].max() > 0}
    low, high = _USUAL_TIMES
    for values, _ in shown.values():
        low, high = min(low, 0.9 * values[values > 0].min()), max(high, 1.1 * values.max())
    bins = np.geomspace(low, high, 90)
    for name, (values, colour) in shown.items():
        axes.hist(np.maximum(values, low), bins=bins, weights=np.full(len(values), 100 / len(values)), color=colour,
                  alpha=0.6, label=f"{name}, median {np.median(values):.0f} us")  # fmt: skip
    for name, (budget, colour) in budgets.items():
        axes.axvline(budget, color=colour, ls="--", label=f"budget of the {name}")
    axes.set(xscale="log", xlabel="wall time [us]", ylabel="share of steps [%]", title="Step times")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2, fontsize=8)


def animate_run(run: Run, path: Path, progress: bool = False) -> None:
    """Write a GIF of the robot moving.

    Parameters
    ----------
    run : Run
    path : Path
        Of the animation.
    progress : bool
        Show a progress bar on stderr.
    """
    every = max(1, round(1.0 / _FRAMES_PER_SECOND / run.dt))
    last = min(len(run.t), int(_LONGEST_ANIMATION / run.dt))
    indices = np.arange(0, last, every)
    poses = poses_along(run, indices)
    shapes = np.stack([eq.shape(40) for eq in poses])
    figure, axes = plt.subplots(figsize=(5, 4.2), dpi=80)
    frame(axes, np.concatenate([run.x[:last, :2], shapes.reshape(-1, 2)]))
    if np.isfinite(run.reference).all():
        axes.plot(*run.reference[:last].T, color=GREY, lw=4, alpha=0.4)
    rods = [axes.plot([], [], color=RODS[i % len(RODS)], lw=3)[0] for i in range(shapes.shape[1])]
    axes.plot(*run.scene.robot.bases.T, "s", color="black", ms=8)
    (trace,) = axes.plot([], [], color=RED, lw=1.2)
    (tip,) = axes.plot([], [], "o", color="black", ms=8)
    clock = axes.set_title(" ")  # above the rods
    figure.tight_layout()
    bar = tqdm(total=len(indices), desc="animation", unit="frame", disable=not progress)

    def show(i: int) -> list[Any]:
        interrupt.check()
        for line, shape in zip(rods, shapes[i], strict=True):
            line.set_data(*shape.T)
        trace.set_data(*run.x[: indices[i] + 1, :2].T)
        tip.set_data([run.x[indices[i], 0]], [run.x[indices[i], 1]])
        clock.set_text(f"t = {run.t[indices[i]]:.2f} s")
        bar.update()
        return [*rods, trace, tip, clock]

    animation = FuncAnimation(figure, show, frames=len(indices), init_func=lambda: [], blit=False)
    try:
        with replacing(path) as draft:
            animation.save(draft, writer=PillowWriter(fps=_FRAMES_PER_SECOND))
    finally:
        bar.close()
        plt.close(figure)
