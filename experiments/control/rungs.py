"""What does each rung of the ladder of physics buy and cost on the seven scenes that state a need?

For every scene in models/scenes with a [need] table: the largest error of the tip of each rung against the scene's
yardstick, driven by the same motor rates, over the time of a plant step (RK4, or Gauss collocation with distributed
rods; see `pcr-mpc choose`). The yardstick is drawn at the bottom. The need is a line, the rung that the scene gets is
ringed, and the star is that rung in the cheapest discretisation that will do. Writes a CSV and a picture.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from tqdm import tqdm

from pcr_mpc import load_scene
from pcr_mpc.errors import NoRungError
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, plt
from pcr_mpc.study.choice.choice import Choice, choose
from pcr_mpc.study.choice.rungs import ladders, levels

SCENES = Path(__file__).parents[2] / "models" / "scenes"
NAMES = ("hold_slow", "release", "payload", "vertical", "heavy_rods", "curved_rods", "near_straight")
COLOURS = {"none": BLUE, "constant": ORANGE, "condensed": GREEN, "full": PURPLE}
# What else a rung leaves out: marker and words.
MARKERS = {
    (): ("o", "nothing else left out"),
    ("weight condensed",): ("s", "weight condensed"),
    ("weight none",): ("^", "no weight of the rods"),
    ("rods plain",): ("D", "no curvature, no stretch"),
    ("payload ignored",): ("v", "no payload"),
    ("weight condensed", "rods plain"): ("P", "weight condensed, no stretch"),
    ("weight none", "rods plain"): ("X", "neither weight nor stretch"),
}
FLOOR = 1e-5  # mm; the yardstick itself is drawn there


def rows_of(choice: Choice) -> list[dict[str, object]]:
    """One row for each rung, and one for the chosen discretisation."""
    need = choice.scene.need
    assert need is not None
    common = {"scene": choice.scene.name, "need_mm": 1e3 * need.tip_accuracy}
    found: list[dict[str, object]] = []
    for one in [*choice.physics, choice.chosen]:
        row = common | levels(one.rung) | {"method": one.rung.method, "integrator": one.rung.integrator}
        row |= {"dt_ms": 1e3 * one.rung.dt, "error_mm": 1e3 * one.error, "step_us": 1e6 * one.step_time}
        row |= {"chosen": levels(one.rung) == levels(choice.chosen.rung), "failure": one.failure}
        found.append(row | {"what": "chosen, as it is run" if one is choice.chosen else "physics"})
    return found


def left_out(choice: Choice, rung: dict[str, str]) -> tuple[str, ...]:
    """Levels of a rung, besides inertia, that are not the highest of the scene's ladders."""
    steps = ladders(choice.scene)
    return tuple(f"{name} {rung[name]}" for name in ("weight", "rods", "payload") if rung[name] != steps[name][-1])


def plot(choices: list[Choice], path: Path) -> None:
    """A panel for each scene."""
    figure, panels = plt.subplots(2, 4, figsize=(11, 6.4), sharex=True, sharey=True)
    used: set[tuple[str, ...]] = set()
    for axes, choice in zip(panels.flat, choices, strict=False):
        need = choice.scene.need
        assert need is not None
        for one in choice.physics:
            without = left_out(choice, levels(one.rung))
            used.add(without)
            at = 1e6 * one.step_time, max(1e3 * one.error, FLOOR)
            chosen = levels(one.rung) == levels(choice.chosen.rung)
            colour = COLOURS[one.rung.inertia]
            axes.plot(*at, MARKERS[without][0], color=colour, ms=6, alpha=0.9, zorder=3)
            if chosen:
                axes.plot(*at, "o", ms=14, mfc="none", mec="black", mew=1.5, zorder=4)
        run = choice.chosen
        axes.plot(1e6 * run.step_time, 1e3 * run.error, "*", color="black", ms=9, mec="white", mew=0.6, zorder=5)
        allowed = 1e3 * need.tip_accuracy
        axes.axhline(allowed, color=GREY, ls="--", lw=1.2)
        style = {"ha": "right", "va": "top", "fontsize": 8.5, "color": "#444444"}
        axes.annotate(f"need {allowed:g} mm", (0.98, allowed), xycoords=("axes fraction", "data"), **style)
        axes.set(xscale="log", yscale="log", title=choice.scene.name, xlim=(8, 6e4), ylim=(FLOOR / 2, 2e2))
        axes.tick_params(labelbottom=True)
    for axes in panels[:, 0]:
        axes.set_ylabel("largest tip error [mm]")
    for axes in [*panels[1, :3], panels[0, 3]]:
        axes.set_xlabel("time per plant step [us]")
    legend = panels.flat[-1]
    legend.axis("off")
    handles = [plt.Line2D([], [], ls="", marker="o", color=colour, label=f"inertia {name}")
               for name, colour in COLOURS.items()]  # fmt: skip
    handles += [plt.Line2D([], [], ls="", marker=marker, color=GREY, label=words)
                for without, (marker, words) in MARKERS.items() if without in used]  # fmt: skip
    ring = {"marker": "o", "ms": 12, "mfc": "none", "mec": "black", "mew": 1.5}
    handles.append(plt.Line2D([], [], ls="", label="chosen", **ring))
    handles.append(plt.Line2D([], [], ls="", marker="*", ms=9, color="black", label="as it is run, cheaper"))
    legend.legend(handles=handles, loc="center left", bbox_to_anchor=(-0.2, 0.5), fontsize=9, title="rungs")
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def main() -> None:
    """Measure, write the CSV, plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/rungs"), help="folder for the results")
    arguments = parser.parse_args()
    folder = arguments.out
    folder.mkdir(parents=True, exist_ok=True)
    choices = []
    for name in tqdm(NAMES, desc="scenes", unit="scene"):
        try:
            choices.append(choose(load_scene(SCENES / f"{name}.toml")))
        except NoRungError as error:
            tqdm.write(str(error))
    write_rows(folder / "rungs.csv", [row for choice in choices for row in rows_of(choice)])
    plot(choices, folder / "rungs.png")
    print(f"written to {folder}")


if __name__ == "__main__":
    main()
