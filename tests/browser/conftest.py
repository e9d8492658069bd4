"""A server of its own process, as the command runs it, and a headless browser."""

import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from playwright.sync_api import sync_playwright

SHOTS = Path("results/browser")
_LOOK = 0.02  # s


def wait(page, expression, patience=20.0):
    """Wait until an expression of the page is true; the page's policy forbids that it asks itself."""
    deadline = time.monotonic() + patience
    while not page.evaluate(f"Boolean({expression})"):
        assert time.monotonic() < deadline, f"never: {expression}; the last frame: {page.evaluate('window.pcr?.frame')}"
        time.sleep(_LOOK)


@pytest.fixture(scope="session")
def address(tmp_path_factory):
    """Of the page of `pcr-mpc view lemniscate`."""
    command = [sys.executable, "-m", "pcr_mpc.cli", "view", "lemniscate", "--no-browser"]
    folder = tmp_path_factory.mktemp("view")
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, cwd=folder) as process:
        line = next(line for line in process.stderr if "http://" in line)
        yield line.split(": ", 1)[1].strip()
        process.send_signal(2)
        _, err = process.communicate(timeout=20)
    assert "Traceback" not in err
    assert process.returncode == 130


@pytest.fixture(scope="session")
def browser():
    found = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    SHOTS.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        launched = playwright.chromium.launch(executable_path=found, args=["--no-sandbox"])
        yield launched
        launched.close()


class Complaints(list):
    """What a page says on its console, and the errors that nobody caught."""

    def of(self, page):
        page.on("console", lambda message: self.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: self.append(f"error: {error}"))
        return page


@pytest.fixture
def opened(browser):
    """Opens pages, and fails where one of them complains."""
    complaints, contexts = Complaints(), []

    def open_page(url, **options):
        context = browser.new_context(**{"viewport": {"width": 1280, "height": 720}, **options})
        contexts.append(context)
        page = complaints.of(context.new_page())
        page.goto(url)
        wait(page, "window.pcr && pcr.frames > 0")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert not complaints


@pytest.fixture
def page(opened, address):
    """The page, its robot at the start with the scene's controller."""
    shown = opened(address)
    shown.evaluate(
        """() => { const send = (m) => pcr.link.send(m);
        send({do: "pause", on: false}); send({do: "speed", factor: 1}); send({do: "release"});
        send({do: "mode", mode: "LR"}); send({do: "controller", name: "lemniscate"}); send({do: "reset"}); }"""
    )
    wait(shown, "pcr.frame.controller === 'lemniscate' && pcr.frame.t < 0.5 && pcr.frame.start === 'LR'")
    return shown
