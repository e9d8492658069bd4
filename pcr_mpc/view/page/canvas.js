"use strict";
// The robot, and all that is drawn around it, in metres on a canvas.

const TRAIL = 3;  // s

class Canvas extends Layers {
  constructor(element) {
    super();
    this.element = element;
    this.context = element.getContext("2d");
    this.trail = [];
    this.flashes = [];
    this.bend = 5;  // 1/m, at the ends of the colours
    this.ghosts = null;
    this.workspace = null;
    this.show = { ghosts: false, workspace: true };
    this.recolour();
    new ResizeObserver(() => this.resize()).observe(element);
  }

  recolour() {
    const style = getComputedStyle(document.documentElement);
    this.colour = new Proxy({}, { get: (_, name) => style.getPropertyValue(name).trim() });
    this.ramp = null;
    this.backdrop = null;
  }

  setAbout(about) {
    this.about = about;
    const reach = Math.max(...about.lengths);
    const xs = about.bases.map((b) => b[0]), ys = about.bases.map((b) => b[1]);
    this.box = [Math.min(...xs) - 0.45 * reach, Math.min(...ys) - 0.3 * reach,
      Math.max(...xs) + 0.45 * reach, Math.max(...ys) + 0.95 * reach];
    for (const p of about.path || []) this.include(p, 0.04);
    this.resize();
  }

  setWorkspace(workspace) {
    this.workspace = workspace.cells ? workspace : null;
    for (const [points] of workspace.cells || []) for (const p of points) this.include(p, 0.01);
    this.resize();
  }

  include(p, margin) {
    const box = this.box;
    if (!box) return;
    box[0] = Math.min(box[0], p[0] - margin); box[1] = Math.min(box[1], p[1] - margin);
    box[2] = Math.max(box[2], p[0] + margin); box[3] = Math.max(box[3], p[1] + margin);
  }

  resize() {
    const ratio = window.devicePixelRatio || 1;
    const { clientWidth: w, clientHeight: h } = this.element;
    if (!w || !h) return;
    this.element.width = Math.round(w * ratio);
    this.element.height = Math.round(h * ratio);
    this.ratio = ratio;
    if (this.box) {
      const [x0, y0, x1, y1] = this.box;
      this.scale = Math.min(w / (x1 - x0), h / (y1 - y0));
      this.x0 = w / 2 - this.scale * (x0 + x1) / 2;
      this.y0 = h / 2 + this.scale * (y0 + y1) / 2;
    }
    this.backdrop = null;
    if (this.last) this.draw(this.last, performance.now() / 1000);
  }

  toScreen(p) { return [this.x0 + this.scale * p[0], this.y0 - this.scale * p[1]]; }

  toWorld(x, y) { return [(x - this.x0) / this.scale, (this.y0 - y) / this.scale]; }

  knob(i, frame) {  // where a motor can be taken hold of
    const length = 0.11 * this.about.lengths[i], base = this.about.bases[i], q = frame.q[i];
    return [base[0] + length * Math.cos(q), base[1] + length * Math.sin(q)];
  }

  take(frame, now) {
    if (this.trail.length && frame.t < this.trail[this.trail.length - 1][2]) this.trail = [];
    this.trail.push([frame.p[0], frame.p[1], frame.t]);
    while (this.trail.length && this.trail[0][2] < frame.t - TRAIL) this.trail.shift();
    for (const row of frame.bend) for (const value of row) this.bend = Math.max(this.bend, Math.abs(value) / 100);
    this.last = frame;
    this.draw(frame, now);
  }

  flash(event, now) { this.flashes.push({ ...event, since: now }); }

  draw(frame, now) {
    if (!this.box || !this.scale) return;
    const c = this.context;
    c.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    this.drawBackdrop(c);
    this.drawGhosts(c);
    this.line(c, this.trail, this.colour["--trail"], 1.6);
    this.drawPlan(c, frame);
    this.drawRods(c, frame);
    this.drawMotors(c, frame);
    this.drawTarget(c, frame);
    this.drawTip(c, frame);
    this.drawFlashes(c, now);
  }

  drawBackdrop(c) {
    if (!this.backdrop) {
      const sheet = this.backdrop = document.createElement("canvas");
      sheet.width = this.element.width;
      sheet.height = this.element.height;
      const d = sheet.getContext("2d");
      d.scale(this.ratio, this.ratio);
      d.fillStyle = this.colour["--ground"];
      d.fillRect(0, 0, sheet.width, sheet.height);
      this.drawGrid(d);
      if (this.workspace && this.show.workspace) this.drawWorkspace(d);
      if (this.about.path) this.line(d, this.about.path, this.colour["--path"], 4, 0.55);
    }
    c.save();
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.drawImage(this.backdrop, 0, 0);
    c.restore();
  }

  drawGrid(c) {
    const [x0, y0] = this.toWorld(0, this.element.clientHeight), [x1, y1] = this.toWorld(this.element.clientWidth, 0);
    const step = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1].find((s) => s * this.scale > 55) || 1;
    c.strokeStyle = this.colour["--grid"];
    c.fillStyle = this.colour["--soft"];
    c.lineWidth = 1;
    c.font = "11px system-ui, sans-serif";
    for (let i = Math.ceil(x0 / step); i * step <= x1; i++) {
      const [x] = this.toScreen([i * step, 0]);
      this.stroke(c, [[x, 0], [x, this.element.clientHeight]]);
      if (x > 30 && x < this.element.clientWidth - 30) c.fillText(`${Math.round(1000 * i * step)}`, x + 3, this.element.clientHeight - 5);
    }
    for (let i = Math.ceil(y0 / step); i * step <= y1; i++) {
      const [, y] = this.toScreen([0, i * step]);
      this.stroke(c, [[0, y], [this.element.clientWidth, y]]);
      if (y > 20 && y < this.element.clientHeight - 24) c.fillText(`${Math.round(1000 * i * step)}${i === 0 ? " mm" : ""}`, 4, y - 3);
    }
  }

  stroke(c, points) {
    c.beginPath();
    points.forEach(([x, y], i) => (i ? c.lineTo(x, y) : c.moveTo(x, y)));
    c.stroke();
  }

  line(c, points, colour, width, alpha = 1, dash = []) {
    if (points.length < 2) return;
    c.save();
    c.strokeStyle = colour;
    c.lineWidth = width;
    c.globalAlpha = alpha;
    c.lineJoin = c.lineCap = "round";
    c.setLineDash(dash);
    this.stroke(c, points.map((p) => this.toScreen(p)));
    c.restore();
  }

  drawPlan(c, frame) {
    if (!frame.plan || frame.plan.length < 2) return;
    this.line(c, frame.plan, this.colour["--plan"], 2, 0.9);
    c.fillStyle = this.colour["--plan"];
    for (const p of frame.plan) this.disc(c, p, 2.4);
  }

  disc(c, p, radius) {
    const [x, y] = this.toScreen(p);
    c.beginPath();
    c.arc(x, y, radius, 0, 2 * Math.PI);
    c.fill();
  }

  colourOf(share) {  // -1 to 1: bent to the right, straight, to the left
    if (!this.ramp) {
      const ends = ["--left", "--straight", "--right"].map((name) => {
        const hex = this.colour[name];
        return [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
      });
      this.ramp = Array.from({ length: 41 }, (_, i) => {
        const s = i / 20 - 1, end = s < 0 ? ends[0] : ends[2], w = Math.sqrt(Math.abs(s));
        return `rgb(${end.map((value, k) => Math.round(w * value + (1 - w) * ends[1][k])).join(",")})`;
      });
    }
    return this.ramp[Math.round(20 * (1 + Math.min(1, Math.max(-1, share))))];
  }

  drawRods(c, frame) {
    c.lineCap = "round";
    c.lineWidth = 5;
    frame.rods.forEach((flat, i) => {
      const line = points(flat).map((p) => this.toScreen(p)), bend = frame.bend[i];
      for (let k = 0; k + 1 < line.length; k++) {
        c.strokeStyle = this.colourOf((bend[k] + bend[k + 1]) / 200 / this.bend);
        this.stroke(c, [line[k], line[k + 1]]);
      }
    });
  }

  drawMotors(c, frame) {
    this.about.bases.forEach((base, i) => {
      const [x, y] = this.toScreen(base), [low, high] = this.about.angles[i], held = frame.hand && frame.hand[0] === i;
      const radius = 0.11 * this.about.lengths[i] * this.scale;
      c.strokeStyle = this.colour["--line"];
      c.lineWidth = 2;
      if (high - low < 6.28) { c.beginPath(); c.arc(x, y, radius, -high, -low); c.stroke(); }
      c.fillStyle = this.colour[`--rod${i % 4}`];
      c.beginPath(); c.arc(x, y, 8, 0, 2 * Math.PI); c.fill();
      const knob = this.toScreen(this.knob(i, frame));
      c.strokeStyle = c.fillStyle;
      c.lineWidth = held ? 3 : 1.5;
      this.stroke(c, [[x, y], knob]);
      c.beginPath(); c.arc(...knob, held ? 9 : 6.5, 0, 2 * Math.PI);
      c.fillStyle = this.colour["--card"]; c.fill(); c.stroke();
      c.fillStyle = this.colour["--soft"];
      c.font = "12px system-ui, sans-serif";
      c.fillText(`q${i}`, x - 8, y + 23);
    });
  }

  drawTarget(c, frame) {
    if (!frame.target) return;
    const [x, y] = this.toScreen(frame.target);
    c.strokeStyle = this.colour["--target"];
    c.lineWidth = 2;
    c.beginPath(); c.arc(x, y, 12, 0, 2 * Math.PI); c.stroke();
    for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) this.stroke(c, [[x + 9 * dx, y + 9 * dy], [x + 16 * dx, y + 16 * dy]]);
  }

  drawTip(c, frame) {
    const tip = this.toScreen(frame.p);
    if (frame.pull) this.drawSpring(c, tip, this.toScreen(frame.pull), Math.hypot(...frame.force));
    const felt = frame.estimated;
    if (felt && Math.hypot(...felt) > 0.05) {
      const reach = 60 * Math.min(1, Math.hypot(...felt) / 4) / Math.hypot(...felt);
      this.arrow(c, tip, [tip[0] + reach * felt[0], tip[1] - reach * felt[1]]);
    }
    c.fillStyle = this.colour["--ink"];
    c.strokeStyle = this.colour["--ground"];
    c.lineWidth = 2;
    c.beginPath(); c.arc(...tip, 7 + 40 * Math.min(0.2, frame.load || 0), 0, 2 * Math.PI); c.fill(); c.stroke();
  }

  arrow(c, from, to) {
    const angle = Math.atan2(to[1] - from[1], to[0] - from[0]);
    c.strokeStyle = this.colour["--force"];
    c.lineWidth = 3;
    this.stroke(c, [from, to]);
    this.stroke(c, [-0.5, 0, 0.5].map((turn) => (turn ? [to[0] - 9 * Math.cos(angle + turn), to[1] - 9 * Math.sin(angle + turn)] : to)));
  }
}

function points(flat) {
  const found = [];
  for (let i = 0; i < flat.length; i += 2) found.push([flat[i] / 1e4, flat[i + 1] / 1e4]);
  return found;
}
