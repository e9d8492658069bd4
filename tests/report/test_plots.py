"""Pictures show what they say: nothing lost, nothing hidden, one name for a thing."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import HoldMotors, inverse_statics, load_scene, simulate
from pcr_mpc.report import plots, timing
from pcr_mpc.report.style import BLUE, GREEN, plt
from pcr_mpc.report.tables import equilibria_table, equilibrium_table
from tests.conftest import MODELS


@pytest.fixture
def kept(monkeypatch):
    """Figures that were drawn, which would else be closed."""
    figures, close = [], plt.close
    monkeypatch.setattr(plots.plt, "close", figures.append)
    yield figures
    for figure in figures:
        close(figure)


@pytest.fixture(scope="module")
def run():
    scene = replace(load_scene(MODELS / "scenes" / "limited.toml"), duration=0.05)
    return simulate(scene, scene.make_plant(), HoldMotors(2))


def test_no_step_is_lost_from_the_histogram(kept):
    rng = np.random.default_rng(5)
    figure, axes = plt.subplots()
    kept.append(figure)
    quick = np.concatenate([[0.0, 0.3, 0.3], rng.uniform(1.0, 9.0, 50)])
    tardy = np.concatenate([rng.uniform(1e4, 9e4, 40), [3e6]])
    plots.plot_times(axes, {"plant step": (quick, BLUE), "control step": (tardy, GREEN)}, {})
    shares = [sum(bar.get_height() for bar in bars) for bars in axes.containers]
    assert shares == pytest.approx([100.0, 100.0])
    edges = axes.get_xlim()
    for bars in axes.containers:
        for bar in bars:
            if bar.get_height():
                assert edges[0] <= bar.get_x()
                assert bar.get_x() + bar.get_width() <= edges[1]


def test_the_timing_histogram_begins_before_its_first_step(kept):
    edges = np.geomspace(1.0, 1e5, 101)
    counts = np.zeros(100, dtype=int)
    counts[[2, 60]] = 5
    histogram = {"edges_us": edges.tolist(), "plant step": {"collector on": counts.tolist(), "collector off": []}}
    figure, panels = plt.subplots(2)
    kept.append(figure)
    timing._histogram(panels[0], histogram)
    timing._tail(panels[1], histogram)
    assert all(axes.get_xlim()[0] <= edges[2] for axes in panels)


def test_the_axis_of_an_error_begins_where_the_error_does(kept):
    t = np.linspace(0.0, 1.0, 501)
    error = 2e-3 + 1e-3 * np.sin(9.0 * t)
    error[0], error[1:4] = 0.0, (1e-14, 1e-9, 1e-5)
    figure, axes = plt.subplots()
    kept.append(figure)
    plots.plot_error(axes, t, error)
    assert axes.get_yscale() == "log"
    low, high = axes.get_ylim()
    assert low == pytest.approx(1e-3)
    assert 3e-3 < high < 3e-2
    drawn = axes.lines[0].get_ydata()
    assert np.isnan(drawn[0])
    assert (drawn[4:] == error[4:]).all()
    plots.plot_error(axes, t, np.zeros_like(t))  # nothing to draw on a logarithmic axis, and no error


def test_legends_of_a_run_cover_nothing_and_a_motor_has_one_name(kept, run, tmp_path):
    run.save(tmp_path)
    plots.plot_run(run, tmp_path / "run.png")
    (figure,) = kept
    figure.canvas.draw()
    path, _, inputs, times = figure.axes
    boxes = []
    for axes in (path, inputs, times):
        box = axes.get_legend().get_window_extent()
        assert not any(box.overlaps(other.get_window_extent()) for other in figure.axes)
        assert not box.overlaps(axes.xaxis.label.get_window_extent())
        boxes.append(box)
    assert not boxes[1].overlaps(boxes[2])
    names = [text.get_text() for text in inputs.get_legend().get_texts()]
    assert names[:2] == ["motor 0 (q0)", "motor 1 (q1)"]
    header = (tmp_path / "run.csv").read_text().splitlines()[0].split(",")
    assert {"q0_rad", "q1_rad", "u0_rad_s", "u1_applied_rad_s", "torque1_Nm"} <= set(header)


def test_what_is_zero_but_for_rounding_reads_as_zero(kept, pair, tmp_path):
    eq = inverse_statics(pair, (0.0, 0.25), mode="LR")
    assert 0 < np.abs(eq.force).max() < 1e-9
    plots.plot_equilibrium(eq, tmp_path / "pose.png")
    assert "F = (0, 0) N, U = 1.614 J" in kept[0].axes[0].get_title()
    assert "force F = dU/dp [N]       (0, 0)" in equilibrium_table(eq)
    assert "(0.756584, -0.756584)" in equilibrium_table(eq)
    assert "-0.000" not in equilibria_table([replace(eq, force=np.array([-1e-14, 1e-13]), p=np.array([-1e-17, 0.25]))])
    small = replace(eq, force=np.array([1e-5, -2e-6]))
    assert "(1e-05, -2e-06)" in equilibrium_table(small)


def test_a_micrometre_robot_has_forces_too(pair):
    """What is rounding is a matter of the robot's own size."""
    scale = 1e-5
    tiny = replace(pair, rods=tuple(replace(rod, base=(scale * rod.base[0], 0.0), length=scale * rod.length,
                                            bending_stiffness=scale**4 * rod.bending_stiffness)
                                    for rod in pair.rods))  # fmt: skip
    eq = inverse_statics(tiny, (0.0, 0.25 * scale), (0.0, 0.5 * scale**2), mode="LR")
    assert "5e-11)" in equilibrium_table(eq)


def test_the_clock_of_the_animation_stands_above_the_rods(kept, run, tmp_path):
    plots.animate_run(run, tmp_path / "run.gif")
    (axes,) = kept[0].axes
    assert not axes.texts
    assert axes.get_title().startswith("t = ")
