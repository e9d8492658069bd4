"""The page in a browser: what is dragged, followed, shown and pressed, against the statics and the robot's state."""

import math
import time

import numpy as np
import pytest

from pcr_mpc import load_scene, shipped
from tests.browser.conftest import SHOTS, wait
from tests.view.view_check import spring_balance


@pytest.fixture(scope="module")
def scene():
    return load_scene(shipped("lemniscate"))


def frame(page):
    return page.evaluate("pcr.frame")


def until(page, holds):
    """The first frame for which it holds, as far as anybody looks."""
    wait(page, f"(f => {holds})(pcr.frame)")
    return frame(page)


def on_screen(page, p):
    """Where a point [m] is on the page [px]."""
    x, y = page.evaluate("(p) => pcr.canvas.toScreen(p)", list(map(float, p)))
    box = page.locator("#robot").bounding_box()
    return box["x"] + x, box["y"] + y


def choose(page, **values):
    for name, value in values.items():
        page.select_option(f"#{name}", value)
        key = {"controller": "controller", "mode": "start"}[name]
        until(page, f"f.{key} === {value!r}")


def test_nothing_is_clipped_at_any_size(opened, address):
    """1280 x 720, dark, and a phone's width; pictures of each are written to be looked at."""
    sizes = {"desktop": (1280, 720, "light"), "dark": (1280, 720, "dark"), "phone": (390, 844, "light")}
    for name, (width, height, scheme) in sizes.items():
        page = opened(address, viewport={"width": width, "height": height}, color_scheme=scheme)
        until(page, "f.rung === 'solved' || f.rung === null")
        page.wait_for_timeout(600)
        page.screenshot(path=SHOTS / f"{name}.png", full_page=name == "phone")
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        cut = page.evaluate(
            """[...document.querySelectorAll("button, dd, dt, h1, h2, .value, .name, label")].filter((e) =>
            e.offsetParent && e.scrollWidth > e.clientWidth + 1 && getComputedStyle(e).display !== "inline")
            .map((e) => e.id || e.textContent)"""
        )
        assert cut in ([], ["title"])
        shown = np.array(
            page.evaluate("pcr.frame.rods.flatMap((rod) => points(rod).map((p) => pcr.canvas.toScreen(p)))")
        )
        robot = page.locator("#robot").bounding_box()
        assert (shown >= 0).all()
        assert (shown <= [robot["width"], robot["height"]]).all()


def test_a_tip_dragged_by_the_mouse_rests_where_the_statics_say(page, scene):
    choose(page, controller="off")
    page.evaluate("pcr.link.send({do: 'reset'})")
    until(page, "f.t < 0.5 && f.controller === 'off'")
    start = scene.start()
    page.mouse.move(*on_screen(page, frame(page)["p"]))
    page.mouse.down()
    page.mouse.move(*on_screen(page, (0.05, 0.19)), steps=12)
    held = until(page, "f.pull")
    began = held["t"]
    rest = until(page, f"f.t > {began + 2.5}")
    page.screenshot(path=SHOTS / "drag.png")
    page.mouse.up()
    wanted = spring_balance(scene.robot, start, page.evaluate("pcr.about.spring"), np.array(rest["pull"]))
    assert np.hypot(*(wanted - start.p)) > 0.02
    assert np.hypot(*(wanted - rest["p"])) < 1e-4  # m
    print(f"\n  tip dragged by mouse: {1e3 * np.hypot(*(wanted - rest['p'])):.5f} mm from the statics")
    until(page, "f.pull === null")


def test_the_path_is_followed_within_the_error_of_the_scene(page):
    until(page, "f.t > 1.2 && f.following")
    page.evaluate(
        """() => { window.errors = []; const look = () => { const f = pcr.frame;
        errors.push(1000 * Math.hypot(f.p[0] - f.target[0], f.p[1] - f.target[1]));
        if (errors.length < 100) requestAnimationFrame(look); }; look(); }"""
    )
    wait(page, "errors.length >= 100", 20.0)
    errors = np.array(page.evaluate("errors"))
    print(f"\n  path: {np.sqrt(np.mean(errors**2)):.4f} mm RMS")
    assert np.sqrt(np.mean(errors**2)) < 0.004  # 0.0019 mm in the records


def test_a_target_dragged_by_the_mouse_is_reached(page):
    until(page, "f.steers && f.target")
    page.click("#tool-target")
    goal = (-0.03, 0.21)
    page.mouse.move(*on_screen(page, (0.0, 0.25)))
    page.mouse.down()
    page.mouse.move(*on_screen(page, goal), steps=10)
    page.mouse.up()
    began = frame(page)["t"]
    rest = until(page, f"!f.following && f.t > {began + 1.5}")
    assert rest["target"] == pytest.approx(goal, abs=1e-3)
    assert np.hypot(*np.subtract(rest["p"], rest["target"])) < 2e-5
    page.click("#follow")
    until(page, "f.following")


def test_a_motor_is_turned_and_a_snap_is_shown(page):
    choose(page, controller="off", mode="LL")
    base = page.evaluate("pcr.about.bases[1]")
    knob = page.evaluate("pcr.canvas.knob(1, pcr.frame)")
    page.mouse.move(*on_screen(page, knob))
    page.mouse.down()
    turned = math.atan2(knob[1] - base[1], knob[0] - base[0])
    for angle in np.linspace(turned, 1.04, 12):
        page.mouse.move(*on_screen(page, (base[0] + 0.05 * math.cos(angle), base[1] + 0.05 * math.sin(angle))))
    wait(page, "pcr.canvas.flashes.length > 0", 20.0)
    page.screenshot(path=SHOTS / "snap.png")
    assert until(page, "f.hand")["hand"][0] == 1
    page.mouse.up()
    until(page, "f.hand === null")
    assert "snap" in page.locator("#events .snap").first.text_content()
    assert page.evaluate("pcr.frame.events.some((event) => event.kind === 'snap' && event.energy > 0.05)")  # J


def test_pause_step_and_reset(page):
    until(page, "f.t > 0.2")
    page.click("#pause")
    still = until(page, "f.paused")
    page.wait_for_timeout(300)
    assert frame(page)["t"] == still["t"]
    assert frame(page)["p"] == still["p"]
    page.click("#step")
    after = until(page, f"f.t > {still['t']}")
    periods = after["t"] / page.evaluate("pcr.about.period")
    assert periods == pytest.approx(round(periods), abs=1e-6)
    assert after["t"] - still["t"] <= 0.01 + 1e-9
    page.click("#reset")
    start = until(page, "f.t === 0")
    assert start["p"] == pytest.approx([0.0, 0.25], abs=1e-6)
    page.click("#pause")
    until(page, "!f.paused && f.t > 0.1")


def test_keys_and_fingers_do_what_the_mouse_does(page, opened, address):
    page.locator("#robot").focus()
    page.keyboard.press(" ")
    until(page, "f.paused")
    page.keyboard.press(" ")
    until(page, "!f.paused")
    page.keyboard.press("ArrowRight")
    assert until(page, "f.pull")
    page.keyboard.press("Escape")
    until(page, "f.pull === null")
    before = page.evaluate("document.documentElement.dataset.theme")
    page.keyboard.press("t")
    assert page.evaluate("document.documentElement.dataset.theme") != before
    page.close()
    phone = opened(address, viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    phone.evaluate("pcr.link.send({do: 'stop'})")
    until(phone, "f.steers && !f.following")
    x, y = on_screen(phone, frame(phone)["p"])
    fingers = phone.context.new_cdp_session(phone)
    fingers.send("Input.dispatchTouchEvent", {"type": "touchStart", "touchPoints": [{"x": x, "y": y}]})
    fingers.send("Input.dispatchTouchEvent", {"type": "touchMove", "touchPoints": [{"x": x + 40, "y": y + 30}]})
    pulled = until(phone, "f.pull && Math.hypot(...f.force) > 0.5")
    assert pulled["pull"][0] > pulled["p"][0]
    phone.screenshot(path=SHOTS / "phone_drag.png")
    fingers.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})
    until(phone, "f.pull === null")


def test_two_pages_see_one_robot_and_one_steers(page, opened, address):
    second = opened(address)
    second.wait_for_selector("#steer:not([hidden])")
    assert second.locator("#pause").is_disabled()
    page.click("#pause")
    mine, theirs = until(page, "f.paused"), until(second, "f.paused")
    assert mine["p"] == theirs["p"]
    assert mine["t"] == theirs["t"]
    second.click("#steer")
    page.wait_for_selector("#steer:not([hidden])")
    second.click("#pause")
    until(page, "!f.paused")


def test_a_page_that_is_loaded_again_finds_the_robot_where_it_is_by_then(page):
    before = until(page, "f.t > 0.3")
    page.reload()
    wait(page, "window.pcr && pcr.frames > 0")
    assert frame(page)["t"] > before["t"]
    page.click("#pause")  # and steers
    until(page, "f.paused")
    page.click("#pause")


def test_ghosts_are_shown_where_the_statics_have_them(page, scene):
    page.click("#stop")
    page.check("#ghosts")
    wait(page, "pcr.canvas.ghosts && pcr.canvas.ghosts.length > 1", 60.0)
    ghosts = page.evaluate("pcr.canvas.ghosts")
    assert "LR" in {ghost["mode"] for ghost in ghosts if ghost["stable"]}
    assert len({ghost["mode"] for ghost in ghosts}) > 1
    page.screenshot(path=SHOTS / "ghosts.png")
    page.uncheck("#ghosts")


def test_who_has_no_token_gets_nothing(browser, address):
    context = browser.new_context()
    page = context.new_page()
    assert page.goto(address.split("?")[0]).status == 403
    page.goto("about:blank")
    # A page from elsewhere, even if it knew the token.
    socket = address.replace("http:", "ws:").replace("/?", "/socket?")
    opened = page.evaluate(
        """(url) => new Promise((done) => { const s = new WebSocket(url);
        s.onopen = () => done(true); s.onerror = () => done(false); })""",
        socket,
    )
    assert not opened
    context.close()


def test_how_fast_it_is(page):
    """Measured and told, not asserted: other work on the machine decides."""
    page.evaluate("pcr.link.send({do: 'follow'})")
    page.wait_for_timeout(500)
    began, first, t = time.monotonic(), page.evaluate("pcr.frames"), frame(page)["t"]
    page.wait_for_timeout(3000)
    passed = time.monotonic() - began
    rate, ratio = (page.evaluate("pcr.frames") - first) / passed, (frame(page)["t"] - t) / passed
    page.mouse.move(*on_screen(page, frame(page)["p"]))
    page.evaluate("pcr.link.delays.length = pcr.link.shown.length = 0")
    page.mouse.down()
    box = page.locator("#robot").bounding_box()
    for k in range(100):
        page.mouse.move(box["x"] + box["width"] / 2 + 0.4 * k, box["y"] + box["height"] / 2 - 60)
        page.wait_for_timeout(10)
    page.mouse.up()
    delays, shown = np.array(page.evaluate("[pcr.link.delays, pcr.link.shown]"))
    assert len(delays) > 20
    said = "; ".join(
        f"{what}: p50 {np.percentile(ms, 50):.1f}, p95 {np.percentile(ms, 95):.1f} ms"
        for what, ms in (("from mouse move to changed plant", delays), ("to the frame that shows it", shown))
    )
    print(f"\n  {rate:.1f} frames/s drawn at {ratio:.3f} of real time; {said}")
