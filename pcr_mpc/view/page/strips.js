"use strict";
// Numbers over the last seconds: motor rates between their limits, and the distance from the target.

const SPAN = 6;  // s

class Strip {
  constructor(element, lines, limit) {
    this.element = element;
    this.lines = lines;  // [colour variable, dash, label]
    this.limit = limit;  // a function that tells the limit on both sides, or null
    this.rows = [];
  }

  take(t, values) {
    if (this.rows.length && t < this.rows[this.rows.length - 1][0]) this.rows = [];
    if (this.rows.length && t === this.rows[this.rows.length - 1][0]) return;
    this.rows.push([t, ...values]);
    while (this.rows[0][0] < t - SPAN) this.rows.shift();
  }

  draw(colour) {
    const ratio = window.devicePixelRatio || 1, w = this.element.clientWidth, h = this.element.clientHeight;
    if (!w || !h) return;
    if (this.element.width !== Math.round(w * ratio)) { this.element.width = Math.round(w * ratio); this.element.height = Math.round(h * ratio); }
    const c = this.element.getContext("2d"), limit = this.limit && this.limit();
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, w, h);
    const all = this.rows.flatMap((row) => row.slice(1)).filter((value) => value !== null);
    const most = Math.max(limit || 0, ...all.map(Math.abs), this.limit ? 0.1 : 1e-3);
    const [low, high] = this.limit ? [-1.15 * most, 1.15 * most] : [0, 1.15 * most];
    const left = 40, end = this.rows.length ? this.rows[this.rows.length - 1][0] : SPAN;
    const x = (t) => left + (w - left - 4) * (1 - (end - t) / SPAN), y = (value) => h - 4 - (h - 8) * (value - low) / (high - low);
    c.font = "10px system-ui, sans-serif";
    c.textAlign = "right";
    c.fillStyle = colour["--soft"];
    for (const value of this.limit ? [-most, 0, most] : [0, most]) {
      c.strokeStyle = colour["--grid"];
      c.lineWidth = 1;
      c.beginPath(); c.moveTo(left, y(value)); c.lineTo(w, y(value)); c.stroke();
      c.fillText(short(value), left - 5, Math.min(h - 3, Math.max(9, y(value) + 3)));
    }
    if (limit) {
      c.strokeStyle = colour["--bad"];
      c.setLineDash([2, 3]);
      for (const side of [-limit, limit]) { c.beginPath(); c.moveTo(left, y(side)); c.lineTo(w, y(side)); c.stroke(); }
    }
    this.lines.forEach(([name, dash], i) => {
      c.strokeStyle = colour[name];
      c.lineWidth = 1.6;
      c.setLineDash(dash);
      c.beginPath();
      let pen = false;
      for (const row of this.rows) {
        const value = row[i + 1];
        if (value === null) { pen = false; continue; }
        if (pen) c.lineTo(x(row[0]), y(value)); else c.moveTo(x(row[0]), y(value));
        pen = true;
      }
      c.stroke();
    });
    c.setLineDash([]);
  }
}

function short(value) {
  const size = Math.abs(value);
  if (size === 0) return "0";
  return size >= 100 ? value.toFixed(0) : size >= 1 ? value.toFixed(1) : size >= 0.01 ? value.toFixed(2) : size >= 0.001 ? value.toFixed(3) : value.toExponential(0);
}
