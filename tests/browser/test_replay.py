"""A run in a page, opened from a file."""

from dataclasses import replace

import numpy as np
import pytest

from pcr_mpc import load_scene, make_controller, shipped, simulate
from pcr_mpc.cli import main
from pcr_mpc.loop.run.run import load_run
from tests.browser.conftest import SHOTS, wait


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    scene = replace(load_scene(shipped("lemniscate")), duration=2.0)
    simulate(scene, scene.make_plant(), make_controller(scene)).save(folder)
    assert main(["replay", str(folder), "--out", str(folder / "page.html")]) == 0
    return folder


def test_it_plays_what_was_recorded_without_a_server(opened, recorded):
    run = load_run(recorded)
    page = opened((recorded / "page.html").as_uri(), color_scheme="dark")
    wait(page, "pcr.frame.t > 0.5")
    page.screenshot(path=SHOTS / "replay.png")
    last = page.evaluate("Number(document.getElementById('scrub').max)")
    for i in (0, last // 3, last):
        page.locator("#scrub").fill(str(i))
        wait(page, f"pcr.frame.n === {i}")
        shown = page.evaluate("pcr.frame")
        k = int(np.argmin(np.abs(run.t - shown["t"])))
        assert shown["p"] == pytest.approx(run.x[k, :2], abs=1e-6)
        assert shown["q"] == pytest.approx(run.x[k, 4:], abs=1e-4)
        # The rods end at the tip.
        assert np.array(shown["rods"])[:, -2:] / 1e4 == pytest.approx(np.array([run.x[k, :2]] * 2), abs=2e-4)
    page.click("#pause")
    wait(page, "!pcr.frame.paused")
    assert not page.locator("#controller").is_visible()
