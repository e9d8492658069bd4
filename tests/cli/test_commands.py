"""Commands and options of the command line that no other test runs."""

import json
import math
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib import image

from pcr_mpc import PCRError, load_scene
from pcr_mpc.cli import main
from pcr_mpc.cli import statics as cli_statics
from pcr_mpc.study.episodes.spread import Spread
from pcr_mpc.study.tuning import space as tuning_space
from tests.conftest import CONTROLLERS, MODELS

PAIR = str(MODELS / "planar_pair.toml")


def test_every_equilibrium_of_a_held_tip(capsys, tmp_path, monkeypatch):
    """Of the same tip and motors, each once, by energy; each with the verdict that its own stiffness gives."""
    picture = tmp_path / "new" / "all.png"
    search, lists = cli_statics.all_equilibria, []
    monkeypatch.setattr(cli_statics, "all_equilibria", lambda *given: lists.append(search(*given)) or lists[-1])
    where = ["statics", PAIR, "--p", "0.18", "0.12", "--q", "0", "180", "--degrees", "--equilibria"]
    assert main([*where, "--picture", str(picture), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert len(found) >= 4
    for eq in found:
        assert eq["p"] == pytest.approx([0.18, 0.12])
        assert eq["q"] == pytest.approx([0.0, math.pi])
        values = np.linalg.eigvalsh(eq["dforce_dp"])
        assert eq["unstable_directions"] == (values < 0).sum()
        assert eq["stable"] == (values > 0).all()
    energies = [eq["energy"] for eq in found]
    assert energies == sorted(energies)
    assert np.diff(energies).min() > 1e-6
    assert {eq["stable"] for eq in found} == {True, False}
    assert image.imread(picture).std() > 0.05
    monkeypatch.setattr(cli_statics, "all_equilibria", lambda *given: lists[-1])  # not once more
    assert main([*where, "--picture", str(picture)]) == 0
    text = capsys.readouterr().out
    assert all(f"{eq['energy']:.4f}"[:6] in text for eq in found)


def test_a_force_on_the_tip_is_balanced_both_ways(capsys):
    force = (0.5, -0.3)
    given = ["--force", *map(str, force)]
    assert main(["statics", PAIR, "--p", "0", "0.25", "--mode", "LR", *given, "--json"]) == 0
    held = json.loads(capsys.readouterr().out)
    assert held["force"] == pytest.approx(force, abs=1e-8)  # F, which the rods need to rest there
    assert held["p"] == pytest.approx([0.0, 0.25], abs=1e-12)
    angles = [repr(angle) for angle in held["q"]]
    assert main(["statics", PAIR, "--q", *angles, *given, "--json"]) == 0
    free = json.loads(capsys.readouterr().out)
    assert free["force"] == pytest.approx(force, abs=1e-6)
    assert main(["statics", PAIR, "--p", "0", "0.25", "--q", *angles, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["force"] == pytest.approx(force, abs=1e-8)
    assert main(["statics", PAIR, "--p", "0", "0.25", "--q", *angles, *given]) == 1
    assert "--force goes with --p alone or --q alone" in capsys.readouterr().err


def test_tune_hands_on_its_options(tmp_path, monkeypatch):
    pytest.importorskip("optuna")
    for folder in (MODELS, CONTROLLERS):
        shutil.copytree(folder, tmp_path / folder.name)
    monkeypatch.chdir(tmp_path)
    seen = []

    def stopped(search, trials, executor):
        seen.append((search, trials))
        raise PCRError("enough")

    monkeypatch.setattr("pcr_mpc.cli.study.tune", stopped)
    scene = str(tmp_path / "models/scenes/limited.toml")
    url = f"sqlite:///{tmp_path / 'shared.db'}"
    assert main(["tune", scene]) == 1
    assert (
        main(["tune", scene, "--storage", url, "--keep-period", "--episodes", "3", "--seed", "7", "--trials", "2"]) == 1
    )
    (plain, trials), (other, fewer) = seen
    assert (trials, fewer) == (50, 2)
    assert (plain.keep_period, plain.episodes, plain.seed) == (False, 24, 0)
    assert plain.storage.endswith("results/tune/limited/study.db")
    assert (other.keep_period, other.episodes, other.seed, other.storage) == (True, 3, 7, url)


def test_a_period_that_is_kept_is_not_searched(tmp_path):
    pytest.importorskip("optuna")
    scene = load_scene(MODELS / "scenes" / "lemniscate.toml")
    search = tuning_space.Search(scene, Spread(), 2, 0, f"sqlite:///{tmp_path / 'study.db'}")
    assert "period" in tuning_space.parameters(search, scene.tuning)
    assert "period" not in tuning_space.parameters(replace(search, keep_period=True), scene.tuning)


def test_commands_start_without_what_they_have_no_use_for():
    """SciPy's optimisers, integrators and splines take a third of a second to import, which plans alone need."""
    slow = '[m for m in ("scipy.optimize", "scipy.integrate", "scipy.interpolate", "scipy.stats") if m in sys.modules]'
    program = (
        f"import sys; import pcr_mpc.cli.statics, pcr_mpc.cli.serve, pcr_mpc.cli.new, pcr_mpc.cli.track; print({slow});"
        f'import pcr_mpc.cli.plan; print("scipy.integrate" in sys.modules)'
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["[]", "False"]
