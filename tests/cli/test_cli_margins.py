"""`pcr-mpc margins`, its table and its picture."""

import json

import numpy as np
import pytest

from pcr_mpc.cli import main
from tests.conftest import MODELS

SCENE = str(MODELS / "scenes" / "lemniscate.toml")


def test_predicted_margins_as_json(tmp_path, capsys):
    arguments = ["margins", SCENE, "--controller", "frozen", "--poses", "1", "--predicted", "--json"]
    assert main([*arguments, "--out", str(tmp_path / "out")]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["controller"] == "frozen"
    margins = said["margins"]
    assert margins["delay_margin_ms"]["predicted"] == pytest.approx(6.8, abs=0.4)
    assert "measured" not in margins["delay_margin_ms"]
    assert len(margins["gain_margin"]) == len(margins["phase_margin_deg"]) == 2
    assert margins["spectral_radius"]["predicted"] < 1.0 < margins["sensitivity_peak"]["predicted"]
    assert min(margins[name]["predicted"] for name in ("stiffness_factor", "mass_factor")) > 1.0
    assert json.loads((tmp_path / "out" / "margins.json").read_text(encoding="utf-8")) == said
    assert (tmp_path / "out" / "margins.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize(("controller", "words"), [("nonlinear", "no gain"), ("open_loop", "measures nothing")])
def test_what_has_no_margins_is_one_line(controller, words, tmp_path, capsys):
    assert main(["margins", SCENE, "--controller", controller, "--out", str(tmp_path)]) == 1
    told = capsys.readouterr().err
    assert words in told
    assert len(told.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_measured_beside_predicted(tmp_path, capsys):
    assert main(["margins", SCENE, "--controller", "frozen", "--json", "--out", str(tmp_path / "out")]) == 0
    margins = json.loads(capsys.readouterr().out)["margins"]
    for name in ("delay_margin_ms", "stiffness_factor", "mass_factor", "motor_lag_ms"):
        assert margins[name]["measured"] == pytest.approx(margins[name]["predicted"], rel=0.15), name
    delay = margins["delay_margin_ms"]
    assert np.isclose(delay["measured_along_path"], delay["predicted_along_path"], rtol=0.05)
