"use strict";
// Where frames come from: a server, or a recorded run that is part of the page. Both have the same shape:
// `on` is told {kind, ...} messages, `send` takes commands.

class Live {
  constructor(on) {
    this.on = on;
    this.id = 0;
    this.sentAt = new Map();
    this.delays = [];  // ms from a command until the plant has moved under it; on one computer clocks agree
    this.shown = [];  // ms until a frame shows it
    this.open();
  }

  open() {
    const query = new URLSearchParams(location.search);
    const scheme = location.protocol === "https:" ? "wss" : "ws";
    this.socket = new WebSocket(`${scheme}://${location.host}/socket?token=${encodeURIComponent(query.get("token") || "")}`);
    this.socket.onmessage = (event) => {
      const message = JSON.parse(event.data);
      if (message.kind === "frame") this.felt(message);
      this.on(message);
    };
    this.socket.onclose = () => {
      this.on({ kind: "lost" });
      setTimeout(() => this.open(), 1000);
    };
  }

  felt(frame) {
    for (const [id, at] of this.sentAt) {
      if (id > frame.heard || (id === frame.heard && !frame.felt)) break;
      if (id === frame.heard) {
        this.delays.push(frame.felt - performance.timeOrigin - at);
        this.shown.push(performance.now() - at);
      }
      this.sentAt.delete(id);
    }
    for (const list of [this.delays, this.shown]) if (list.length > 1000) list.splice(0, 500);
  }

  send(message) {
    if (this.socket.readyState !== WebSocket.OPEN) return;
    if (message.do !== "seen") {
      this.id += 1;
      message.id = this.id;
      this.sentAt.set(this.id, performance.now());
    }
    this.socket.send(JSON.stringify(message));
  }

  drawn(frame) {
    this.send({ do: "seen", n: frame.n });
  }
}

class Recording {
  constructor(data, on) {
    this.frames = data.frames;
    this.events = data.events;
    this.on = on;
    this.at = 0;
    this.time = this.frames[0].t;
    this.paused = false;
    this.last = null;
    setTimeout(() => {
      on({ kind: "about", ...data.about });
      requestAnimationFrame((now) => this.turn(now));
    });
  }

  turn(now) {
    const end = this.frames[this.frames.length - 1].t;
    if (!this.paused && this.last !== null) {
      this.time += Math.min(now - this.last, 100) / 1000;
      if (this.time > end) this.time = this.frames[0].t;
    }
    this.last = now;
    let i = this.at;
    if (this.frames[i].t > this.time) i = 0;
    while (i + 1 < this.frames.length && this.frames[i + 1].t <= this.time) i += 1;
    this.show(i);
    requestAnimationFrame((later) => this.turn(later));
  }

  show(i) {
    if (i === this.at && this.shown) return;
    if (i < this.at) this.on({ kind: "again" });
    this.at = i;
    this.shown = true;
    const frame = this.frames[i];
    const events = this.events.filter((event) => event.t <= frame.t + 1e-6);
    this.on({ kind: "frame", n: i, paused: this.paused, events, ...frame });
  }

  send(message) {
    if (message.do === "pause") this.paused = message.on;
    if (message.do === "reset") this.time = this.frames[0].t;
    if (message.do === "scrub") {
      this.paused = true;
      this.time = this.frames[message.i].t;
    }
    this.shown = false;
  }

  drawn() {}
}
