"use strict";
// What is drawn behind the robot and over it: workspace, ghosts, the spring of a hand, snaps.

const REASONS = {
  "type 2": ["--type2", [], "fold: the tip snaps"],
  "type 1": ["--type1", [7, 4], "motors lose a direction"],
  "rod limit": ["--type2", [2, 3], "limit of a rod"],
  stops: ["--ink", [5, 5], "stop of a motor"],
  reach: ["--other", [1, 4], "rod stretched out"],
};
const FLASH = 1.6;  // s

class Layers {
  drawWorkspace(c) {
    c.save();
    c.fillStyle = this.colour["--space"];
    for (const [points, stiffness, within] of this.workspace.cells) {
      // Where a motor would be beyond its stop, there is hardly a shade.
      c.globalAlpha = within ? 0.1 + 0.22 * Math.min(1, Math.max(0, Math.log10(Math.max(stiffness, 1)) / 2.3)) : 0.05;
      c.beginPath();
      points.forEach((p, i) => { const [x, y] = this.toScreen(p); if (i) c.lineTo(x, y); else c.moveTo(x, y); });
      c.fill();
    }
    c.restore();
    for (const [ends, reason] of this.workspace.edge) {
      const [colour, dash] = REASONS[reason] || REASONS.reach;
      this.line(c, ends, this.colour[colour], 2.5, 0.9, dash);
    }
  }

  drawGhosts(c) {
    if (!this.show.ghosts || !this.ghosts) return;
    const here = this.last.p;
    for (const ghost of this.ghosts) {
      if (Math.hypot(ghost.p[0] - here[0], ghost.p[1] - here[1]) < 0.01) continue;  // the robot itself
      for (const flat of ghost.rods) this.line(c, points(flat), this.colour["--ghost"], 3, ghost.stable ? 0.55 : 0.4, ghost.stable ? [] : [3, 6]);
      const [x, y] = this.toScreen(ghost.p);
      c.fillStyle = this.colour["--soft"];
      c.font = "11px system-ui, sans-serif";
      c.strokeStyle = this.colour["--ground"];
      c.lineWidth = 3;
      c.lineJoin = "round";
      const label = `${ghost.mode} ${short(ghost.energy)} J`;
      c.strokeText(label, x + 8, y - 8);
      c.fillText(label, x + 8, y - 8);
    }
  }

  drawSpring(c, from, to, force) {
    const length = Math.hypot(to[0] - from[0], to[1] - from[1]);
    c.strokeStyle = c.fillStyle = this.colour["--ink"];
    c.lineWidth = 1.6;
    if (length > 12) {
      const along = [(to[0] - from[0]) / length, (to[1] - from[1]) / length], turns = Math.max(6, Math.min(20, Math.round(length / 9)));
      const coil = Array.from({ length: turns + 1 }, (_, i) => {
        const side = i === 0 || i === turns ? 0 : i % 2 ? 5 : -5, at = length * i / turns;
        return [from[0] + along[0] * at - along[1] * side, from[1] + along[1] * at + along[0] * side];
      });
      this.stroke(c, coil);
    }
    c.beginPath(); c.arc(...to, 5, 0, 2 * Math.PI); c.stroke();
    c.font = "600 13px system-ui, sans-serif";
    c.fillText(`${force.toFixed(2)} N`, to[0] + 12, to[1] - 10);
  }

  drawFlashes(c, now) {
    this.flashes = this.flashes.filter((each) => now - each.since < FLASH);
    for (const each of this.flashes) {
      const share = (now - each.since) / FLASH, [x, y] = this.toScreen(each.p);
      c.save();
      c.globalAlpha = 1 - share;
      c.strokeStyle = c.fillStyle = this.colour["--bad"];
      c.lineWidth = 6 * (1 - share) + 1;
      c.beginPath(); c.arc(x, y, 14 + 110 * share, 0, 2 * Math.PI); c.stroke();
      c.font = "700 16px system-ui, sans-serif";
      c.textAlign = "center";
      c.fillText(each.energy === undefined ? "snap" : `snap: ${(1000 * each.energy).toFixed(0)} mJ lost`, Math.min(Math.max(x, 90), this.element.clientWidth - 90), Math.max(30, y - 28 - 30 * share));
      c.restore();
    }
  }
}
