"""Which statics method survives a bad guess?

The paper expects multiple shooting to be more robust than single shooting and gives no figures. Here every method
starts from the same wrong guesses, at poses of the default robot in five classes (both rods of a pose belong to it):

  gentle         loads below 2.6 EI/L^2
  bent           turning by more than 2 rad, load lambda at 40 to 75 % of its limit lambda_c
  taut           in tension, stretched to more than 0.9 of the length, lambda = 6 to 16
  near fold      lambda within 0.3 to 3 % of lambda_c; stable with the tip held (K is never positive definite there)
  near buckling  almost straight along the chord, in compression; bowed left and right are both stable, tip held

Two studies:

  perturbed nodes  A smooth random function of the arc length, of standard deviation sigma at every point, is added to
                   the exact [theta, n_x, n_y, m] in units of [1 rad, |n|, |n|, max |m|] (EI/L^2 and EI/L at least).
                   It is sampled at the method's own nodes, so that all see the same wrong rod; but single shooting
                   and N = 1 read only the loads at its base. sigma = 0 is a control.
  moved tip        The exact nodes of a pose are the guess for a tip a distance away, motors held, in one solve without
                   predictor; the right answer is the branch followed by the closed form in steps of L/100.

"single" is the project's single shooting (SciPy, Levenberg-Marquardt); "N = 1" has the same unknowns and multiple
shooting's damped Newton's method, which tells the formulation from the solver. All shooting takes 16 steps of order 8
a rod (N = 32: one a segment). Outcomes: "same" branch (forces within 1e-4), "other" stable shape of the rods,
"unstable" shape, "failed" (with the error; also where the steps do not resolve the rod found), and "branch ends" where
there is no right answer, which the shares leave out.

Writes basins_trials.csv (one row a trial), _poses.csv, _summary.csv (shares), _half.csv (the size at which half of the
trials are lost, and its ratio to single shooting's with a 90 % interval by resampling the poses) and two pictures. The
pictures in docs/ are those of --seeds 6.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

from experiments.statics.basin_trials import CLASSES, METHODS, STUDIES, Plan, Row, measure
from pcr_mpc import load_robot
from pcr_mpc.report.csv_rows import write_rows
from pcr_mpc.report.style import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, SKY, plt

STYLES = dict(
    zip(
        METHODS,
        [(RED, "s-"), (RED, "s:"), (ORANGE, "^-"), (PURPLE, "v-"), (BLUE, "o-"), (SKY, "d-"), (GREY, "x-"),
         (GREEN, "*-")],
        strict=True,
    )
)  # fmt: skip
OUTCOMES = ("same", "other", "unstable", "failed")
MOST_ENDED = 0.25  # sizes at which fewer of the branches than this are left do not count
RESAMPLES = 400


QUICK = Plan(poses=2, sigmas=(1e-3,), distances=(1e-3,), methods=("single", "N = 8", "closed form"))


def successes(trials: list[Row], study: str, name: str, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Sizes above zero; trials back on the branch and all trials of each pose and size, shape (2, poses, sizes)."""
    wanted = (study, name, method)
    mine = [row for row in trials if (row["study"], row["class"], row["method"]) == wanted and row["size"] > 0]
    sizes = sorted({row["size"] for row in mine})
    counts = np.zeros((2, 1 + max(row["pose"] for row in mine), len(sizes)))
    for row in mine:
        if row["outcome"] != "branch ends":
            at = row["pose"], sizes.index(row["size"])
            counts[0][at] += row["outcome"] == "same"
            counts[1][at] += 1
    return np.array(sizes), counts


def half_size(sizes: np.ndarray, counts: np.ndarray) -> tuple[float, str]:
    """Size at which the share of successes first falls below one half; "<" or ">" if that is off the ends."""
    same, total = counts.sum(axis=1)
    enough = total > MOST_ENDED * total.max(initial=1.0)
    if not enough.any():
        return np.nan, "?"
    share, sizes = same[enough] / total[enough], sizes[enough]
    below = np.flatnonzero(share < 0.5)
    if not below.size:
        return float(sizes[-1]), ">"
    i = int(below[0])
    if i == 0:
        return float(sizes[0]), "<"
    part = (share[i - 1] - 0.5) / (share[i - 1] - share[i])
    return float(sizes[i - 1] * (sizes[i] / sizes[i - 1]) ** part), ""


def summarise(trials: list[Row]) -> list[Row]:
    """Shares of the outcomes for every study, class, method and size; branches that end are counted apart."""
    cells: dict[tuple[Any, ...], list[str]] = {}
    for row in trials:
        cells.setdefault((row["study"], row["class"], row["method"], row["size"]), []).append(row["outcome"])
    rows = []
    for key, outcomes in sorted(cells.items(), key=lambda cell: (cell[0][0], cell[0][1], cell[0][3])):
        judged = [outcome for outcome in outcomes if outcome in OUTCOMES]
        row = dict(zip(("study", "class", "method", "size"), key, strict=True)) | {"trials": len(judged)}
        row |= {name: round(judged.count(name) / len(judged), 4) if judged else "" for name in OUTCOMES}
        rows.append(row | {"branch_ends": len(outcomes) - len(judged)})
    return rows


def half_sizes(trials: list[Row], plan: Plan) -> list[Row]:
    """Where half of the trials are lost, and how many times further than for single shooting that is."""
    rows = []
    for study in STUDIES:
        for name in CLASSES:
            halves = {}
            for method in plan.methods:
                sizes, counts = successes(trials, study, name, method)
                draws = np.random.default_rng(0).integers(counts.shape[1], size=(RESAMPLES, counts.shape[1]))
                resampled = np.array([half_size(sizes, counts[:, draw])[0] for draw in draws])
                halves[method] = (*half_size(sizes, counts), resampled)
            single, single_bound, single_resampled = halves["single"]
            for method, (half, bound, resampled) in halves.items():
                # A bound on single shooting's half bounds the ratio the other way; two opposed bounds say nothing.
                bounds = {bound, {"<": ">", ">": "<"}.get(single_bound, single_bound)} - {""}
                ratio = half / single
                spread = np.nanpercentile(resampled / single_resampled, [5, 95]) if np.isfinite(ratio) else [np.nan] * 2
                rows.append(
                    {
                        "study": study, "class": name, "method": method, "half_bound": bound, "half": half,
                        "ratio_bound": "?" if len(bounds) > 1 else "".join(bounds), "ratio": ratio,
                        "ratio_low": spread[0], "ratio_high": spread[1],
                    }
                )  # fmt: skip
    return rows


def plot_halves(halves: list[Row], path: Path) -> None:
    """For each study the size at which half of the trials are lost, method by class."""
    methods = list(dict.fromkeys(row["method"] for row in halves))
    figure, charts = plt.subplots(1, 2, figsize=(11, 3.8), sharey=True)
    titles = ("perturbed nodes: sigma, in natural units", "moved tip: distance / L")
    for chart, study, title in zip(charts, STUDIES, titles, strict=True):
        mine = {(row["class"], row["method"]): row for row in halves if row["study"] == study}
        rows = [[mine[name, method] for method in methods] for name in CLASSES]
        values = np.log10([[row["half"] for row in line] for line in rows])
        chart.imshow(values, cmap="cividis", aspect="auto")
        dark = values < (np.nanmin(values) + np.nanmax(values)) / 2
        for (i, j), is_dark in np.ndenumerate(dark):
            half = rows[i][j]["half"]
            number = f"{half:.2g}" if half >= 0.01 else f"{half:.0e}".replace("e-0", "e-")
            text = rows[i][j]["half_bound"] + number
            chart.text(j, i, text, ha="center", va="center", color="white" if is_dark else "black", fontsize=9)
        chart.set_xticks(range(len(methods)), methods, rotation=35, ha="right", rotation_mode="anchor")
        chart.set_yticks(range(len(CLASSES)), list(CLASSES))
        chart.set_xlabel("method (N: segments of multiple shooting)")
        chart.tick_params(length=0)
        chart.grid(False)
        chart.spines[:].set_visible(False)
        chart.set_title(title, fontsize=10.5)
    figure.suptitle("How wrong the guess may be until half of the trials miss the branch", y=0.99)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def plot_shares(trials: list[Row], path: Path) -> None:
    """Success against the perturbation in the two classes in which the methods differ most."""
    figure, panels = plt.subplots(1, 2, figsize=(11, 4.2), sharey=True)
    for panel, name in zip(panels, ("taut", "gentle"), strict=True):
        for method in dict.fromkeys(row["method"] for row in trials):
            sizes, counts = successes(trials, "perturbed nodes", name, method)
            same, total = counts.sum(axis=1)
            colour, line = STYLES[method]
            panel.semilogx(sizes, 100 * same / total, line, color=colour, ms=5, label=method)
        panel.axhline(50, color=GREY, lw=0.8)
        panel.set(xlabel="perturbation sigma of the nodes, in natural units", title=f"{name} rods", ylim=(-3, 103))
    panels[0].set_ylabel("back on the same branch [%]")
    panels[1].legend(fontsize=9, loc="lower left")
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def main() -> None:
    """Measure, write the tables, plot."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("results/basins"), help="folder for the results")
    parser.add_argument(
        "--seeds",
        type=int,
        default=1,
        help="guesses a pose; two minutes each, mostly spent by single shooting in failing",
    )
    parser.add_argument("--quick", action="store_true", help="ten seconds, three methods: does it run?")
    arguments = parser.parse_args()
    folder, plan = arguments.out, QUICK if arguments.quick else Plan(seeds=arguments.seeds)
    folder.mkdir(parents=True, exist_ok=True)
    trials, poses = measure(load_robot(Path(__file__).parents[2] / "models" / "planar_pair.toml"), plan)
    halves = half_sizes(trials, plan)
    for name, rows in {"trials": trials, "poses": poses, "summary": summarise(trials), "half": halves}.items():
        write_rows(folder / f"basins_{name}.csv", rows)
    plot_halves(halves, folder / "basins.png")
    plot_shares(trials, folder / "basins_shares.png")
    print(f"written to {folder}")


if __name__ == "__main__":
    main()
