"use strict";
// What fingers, mouse and keys do.

const NEAR = 30;  // px, to a motor's knob
const GRIP = 90;  // px, to the tip
const KEY_STEP = 0.004;  // m, an arrow key moves

class Hands {
  constructor(canvas, send, look) {
    this.canvas = canvas;
    this.send = send;
    this.look = look;  // () -> the last frame, and whether this page may steer
    this.tool = "tip";
    this.held = null;  // {kind, i}
    this.keyed = null;  // where the arrow keys have led
    const element = canvas.element;
    element.addEventListener("pointerdown", (event) => this.down(event));
    element.addEventListener("pointermove", (event) => this.move(event));
    for (const kind of ["pointerup", "pointercancel", "lostpointercapture"]) element.addEventListener(kind, () => this.up());
    element.addEventListener("contextmenu", (event) => event.preventDefault());
    document.addEventListener("keydown", (event) => this.key(event));
    window.addEventListener("blur", () => this.up());
    $("tool-tip").onclick = () => this.choose("tip");
    $("tool-target").onclick = () => this.choose("target");
    $("pause").onclick = () => this.pause();
    $("step").onclick = () => this.send({ do: "step" });
    $("reset").onclick = () => this.send({ do: "reset" });
    $("follow").onclick = () => this.send({ do: "follow" });
    $("stop").onclick = () => this.send({ do: "stop" });
    $("record").onclick = () => this.send({ do: "record", on: this.look().frame.recording === null });
  }

  choose(tool) {
    this.tool = tool;
    this.keyed = null;
    for (const each of ["tip", "target"]) $(`tool-${each}`).setAttribute("aria-pressed", String(each === tool));
  }

  pause() {
    const { frame } = this.look();
    if (frame) this.send({ do: "pause", on: !frame.paused });
  }

  at(event) {
    const box = this.canvas.element.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  }

  down(event) {
    const { frame, steers, live } = this.look();
    if (!frame || !steers || !live || event.button > 0) return;
    const [x, y] = this.at(event);
    const away = (p) => { const [px, py] = this.canvas.toScreen(p); return Math.hypot(px - x, py - y); };
    const touch = event.pointerType === "touch" ? 1.4 : 1;
    const motor = this.canvas.about.bases.findIndex((_, i) => away(this.canvas.knob(i, frame)) < NEAR * touch / 1.4);
    if (motor >= 0) this.held = { kind: "motor", i: motor, turned: frame.q[motor] };
    else if (this.tool === "target" && frame.steers) this.held = { kind: "target" };
    else if (away(frame.p) < GRIP * touch) this.held = { kind: "tip" };
    else return;
    this.canvas.element.setPointerCapture(event.pointerId);
    this.canvas.element.focus({ preventScroll: true });
    event.preventDefault();
    this.move(event);
  }

  move(event) {
    if (!this.held) return;
    const p = this.canvas.toWorld(...this.at(event));
    if (this.held.kind === "motor") {
      const base = this.canvas.about.bases[this.held.i], turn = 2 * Math.PI;
      const seen = Math.atan2(p[1] - base[1], p[0] - base[0]);
      // The turn on which the motor is.
      this.held.turned = seen + turn * Math.round((this.held.turned - seen) / turn);
      this.send({ do: "motor", i: this.held.i, angle: this.held.turned });
    } else this.send({ do: this.held.kind === "tip" ? "drag" : "target", x: p[0], y: p[1] });
  }

  up() {
    if (!this.held) return;
    if (this.held.kind !== "target") this.send({ do: "release" });
    this.held = null;
    this.keyed = null;
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || /^(INPUT|SELECT|TEXTAREA)$/.test(event.target.tagName)) return;
    const { frame, live } = this.look();
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    const step = arrows[event.key];
    if (step && frame && live) {
      const from = this.keyed || (this.tool === "target" ? frame.target || frame.p : frame.pull || frame.p);
      const size = event.shiftKey ? 4 * KEY_STEP : KEY_STEP;
      this.keyed = [from[0] + size * step[0], from[1] + size * step[1]];
      this.send({ do: this.tool === "target" ? "target" : "drag", x: this.keyed[0], y: this.keyed[1] });
    } else if (event.key === "Escape") {
      this.keyed = null;
      this.held = null;
      if (live) this.send({ do: "release" });
    } else if (event.key === " " && event.target.tagName !== "BUTTON") this.pause();
    else {
      const press = { ".": "step", r: "reset", f: "follow", s: "stop", g: "ghosts", w: "workspace", t: "theme", d: "tool-tip", m: "tool-target" };
      const id = press[event.key.toLowerCase()];
      if (!id || $(id).disabled || !$(id).offsetParent) return;
      $(id).click();
    }
    event.preventDefault();
  }
}
