"use strict";
// Figures, bars, settings and events beside the robot.

const $ = (id) => document.getElementById(id);
const RUNGS = { solved: "solved", softened: "limits softened", shifted_plan: "last plan, shifted", lqr: "LQR", hold: "motors held" };

function length(mm) { return mm < 0.1 ? `${(1000 * mm).toFixed(mm < 0.01 ? 1 : 0)} µm` : `${short(mm)} mm`; }

function make(tag, properties = {}, ...children) {
  const element = Object.assign(document.createElement(tag), properties);
  element.append(...children);
  return element;
}

// What is set is laid out and painted anew, even where nothing changes.
function put(element, name, value) { if (element[name] !== value) element[name] = value; }

class Panel {
  constructor(send) {
    this.send = send;
    this.figures = {};
    this.bars = {};
    this.dials = {};
    this.known = 0;
  }

  setAbout(about) {
    this.about = about;
    document.title = `${about.scene} · pcr_mpc`;
    $("title").textContent = `${about.scene} · ${about.robot}`;
    $("figures").replaceChildren();
    for (const [key, label] of [["rung", "answer"], ["tip", "tip"], ["error", "off target"], ["iterations", "iterations"],
      ["force", "pull"], ["estimated", "felt"], ["mode", "mode"], ["load", "load"]]) {
      this.figures[key] = make("dd", { textContent: "–" });
      $("figures").append(make("div", { className: key }, make("dt", { textContent: label }), this.figures[key]));
    }
    $("bars").replaceChildren();
    this.bars = {};
    about.bases.forEach((_, i) => this.addBar(`rod${i}`, `rod ${i} to its fold`));
    this.addBar("soft", "softest stiffness");
    about.bases.forEach((_, i) => this.addBar(`torque${i}`, `torque ${i}`));
    if (about.live) this.addSettings(about);
  }

  addBar(key, name) {
    const bar = { fill: make("div", { className: "fill" }), mark: make("div", { className: "mark" }), value: make("span", { className: "value" }) };
    bar.element = make("div", { className: "bar" }, make("span", { className: "name", textContent: name }),
      make("div", { className: "track" }, bar.fill, bar.mark), bar.value);
    this.bars[key] = bar;
    $("bars").append(bar.element);
  }

  addSettings(about) {
    const fill = (id, values, text) => $(id).replaceChildren(...values.map((value) => make("option", { value, textContent: text(value) })));
    fill("controller", about.controllers, (name) => (name === "off" ? "off: motors stand" : name));
    fill("mode", about.modes, (mode) => mode);
    fill("speed", [0.05, 0.1, 0.25, 0.5, 1, 2], (factor) => (factor === 1 ? "real time" : `${factor} × real time`));
    $("controller").onchange = (event) => this.send({ do: "controller", name: event.target.value });
    $("mode").onchange = (event) => this.send({ do: "mode", mode: event.target.value });
    $("speed").onchange = (event) => this.send({ do: "speed", factor: Number(event.target.value) });
    $("dials").replaceChildren();
    this.dials = {};
    for (const [name, dial] of Object.entries(about.dials)) {
      const value = make("span", { className: "value" });
      const input = make("input", { type: "range", id: `dial-${name}`, min: dial.least, max: dial.most, step: (dial.most - dial.least) / 200 });
      input.oninput = () => { value.textContent = this.shown(dial, Number(input.value)); delete input.dataset.shown; };
      // Only once it is let go: what a controller is told of makes it begin anew.
      input.onchange = () => this.send({ do: "set", name, value: Number(input.value) });
      const label = make("label", { className: "name", htmlFor: input.id, textContent: dial.label + (dial.told ? "" : " (not told)") });
      label.title = dial.told ? "The controller is told" : "The controller is not told";
      this.dials[name] = { input, value, dial };
      $("dials").append(make("div", { className: "dial" }, label, value, input));
    }
  }

  shown(dial, value) { return `${short(dial.scale * value)} ${dial.unit}`; }

  write(key, text, bad = false) {
    const field = this.figures[key];
    put(field, "textContent", text);
    field.classList.toggle("bad", bad);
  }

  setBar(key, share, text, bad, mark = null) {
    const bar = this.bars[key];
    put(bar.fill.style, "transform", `scaleX(${Math.min(1, Math.max(0, share)).toFixed(3)})`);
    put(bar.value, "textContent", text);
    bar.element.classList.toggle("bad", bad);
    put(bar.mark, "hidden", mark === null);
    if (mark !== null) put(bar.mark.style, "left", `${(100 * Math.min(1, mark)).toFixed(1)}%`);
  }

  take(frame) {
    const { about } = this, limits = about.limits;
    put($("clock"), "textContent", `${frame.t.toFixed(2)} s` + (about.live ? `  ${frame.paused ? "paused" : `${(frame.ratio ?? 1).toFixed(2)} ×`}` : ""));
    const error = frame.target && 1000 * Math.hypot(frame.p[0] - frame.target[0], frame.p[1] - frame.target[1]);
    this.write("error", error === null || error === undefined ? "–" : length(error));
    const limited = frame.limits && frame.limits.length ? ` (${frame.limits.join(", ")})` : "";
    this.write("rung", frame.rung ? (RUNGS[frame.rung] || frame.rung) + limited : frame.hand ? "by hand" : frame.controller || "–",
      Boolean(frame.rung) && frame.rung !== "solved");
    put(this.figures.rung, "title", limited);
    this.write("tip", `${(1000 * frame.p[0]).toFixed(1)}, ${(1000 * frame.p[1]).toFixed(1)} mm`);
    this.write("iterations", frame.iterations === null || frame.iterations === undefined ? "–" : String(frame.iterations));
    this.write("force", frame.pull ? `${Math.hypot(...frame.force).toFixed(2)} N` : "–");
    this.write("estimated", frame.estimated ? `${Math.hypot(...frame.estimated).toFixed(2)} N` : "–");
    this.write("mode", frame.mode);
    this.write("load", `${(1000 * (frame.load || 0)).toFixed(0)} g`);
    frame.margin.forEach((margin, i) => {
      if (margin === null) this.setBar(`rod${i}`, 0, "not known", false);
      else this.setBar(`rod${i}`, margin, `${(100 * margin).toFixed(0)} %`, margin < (limits.rod_margin || 0.05), limits.rod_margin);
    });
    const stiff = (value) => Math.log10(1 + Math.max(0, value)) / 3;
    this.setBar("soft", stiff(frame.soft), `${short(frame.soft)} N/m`, frame.soft < (limits.stiffness || 0), limits.stiffness ? stiff(limits.stiffness) : null);
    frame.torque.forEach((torque, i) => {
      const most = limits.torque;
      this.setBar(`torque${i}`, most ? Math.abs(torque) / most : 0, `${torque.toFixed(2)} N m`, Boolean(most) && Math.abs(torque) > most);
    });
    this.press(frame);
  }

  press(frame) {
    put($("pause"), "textContent", frame.paused ? "Run" : "Pause");
    put($("pause"), "ariaPressed", String(Boolean(frame.paused)));
    if (!this.about.live) return;
    put($("follow"), "ariaPressed", String(frame.following));
    $("follow").disabled = this.looking || !this.about.path || !frame.steers;
    $("stop").disabled = $("tool-target").disabled = this.looking || !frame.steers;
    put($("record"), "textContent", frame.recording === null ? "Record" : `Stop recording, ${frame.recording.toFixed(1)} s`);
    put($("record"), "ariaPressed", String(frame.recording !== null));
    const choose = (id, value) => { if (document.activeElement !== $(id) && $(id).value !== String(value)) $(id).value = String(value); };
    choose("controller", frame.controller);
    choose("mode", frame.start);
    choose("speed", frame.speed);
    for (const [name, { input, value, dial }] of Object.entries(this.dials)) {
      if (document.activeElement === input) continue;
      if (Number(input.dataset.shown) === frame.set[name]) continue;
      input.value = input.dataset.shown = frame.set[name];
      value.textContent = this.shown(dial, frame.set[name]);
    }
  }

  setRole(role) {
    this.looking = !role.steers && !role.free;
    const others = role.pages - 1;
    $("role").textContent = this.looking ? "looking on: another page steers" : others ? `you steer, ${others} look${others === 1 ? "s" : ""} on` : "";
    $("steer").hidden = !this.looking;
    for (const element of document.querySelectorAll("#bar button, #choices select, #dials input")) element.disabled = this.looking;
  }

  takeEvents(events) {  // those that are new, the oldest first
    const fresh = events.filter((each) => each.n > this.known);
    for (const each of fresh) {
      this.known = each.n;
      const item = make("li", { className: each.kind }, make("time", { textContent: `${each.t.toFixed(2)} s` }), each.message);
      $("events").prepend(item);
      while ($("events").children.length > 40) $("events").lastChild.remove();
    }
    return fresh;
  }

  forget() {
    this.known = 0;
    $("events").replaceChildren();
  }

  banner(text, seconds = 5) {
    $("banner").textContent = text;
    $("banner").hidden = !text;
    clearTimeout(this.timer);
    if (text && seconds) this.timer = setTimeout(() => { $("banner").hidden = true; }, 1000 * seconds);
  }
}
