"use strict";
// The page: messages in, one drawing for each frame of the screen, commands out.

const READ_EVERY = 90;  // ms

(() => {
  const data = JSON.parse($("data").textContent);
  const live = data === null;
  document.body.classList.toggle("replay", !live);
  let frame = null, about = null, role = { steers: live, free: false };
  const send = (message) => link.send(message);
  const canvas = new Canvas($("robot")), panel = new Panel(send);
  let strips = [];
  const queue = [];  // frames to be drawn, one by one: the screen's clock and the server's beat against each other

  function recolour(theme) {
    document.documentElement.dataset.theme = theme;
    canvas.recolour();
    if (canvas.last) canvas.draw(canvas.last, performance.now() / 1000);
    for (const strip of strips) strip.draw(canvas.colour);
    drawLegend();
  }

  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  recolour(dark.matches ? "dark" : "light");
  dark.addEventListener("change", (event) => recolour(event.matches ? "dark" : "light"));
  $("theme").onclick = () => recolour(document.documentElement.dataset.theme === "dark" ? "light" : "dark");

  function drawLegend() {
    if (!about) return;
    const shown = canvas.workspace && canvas.show.workspace ? [...new Set(canvas.workspace.edge.map(([, reason]) => reason))] : [];
    const rows = shown.filter((reason) => REASONS[reason]).map((reason) => [...REASONS[reason]]);
    rows.push(["ramp", [], "curvature"]);
    if (frame && frame.plan) rows.push(["--plan", [], "plan"]);
    $("legend").replaceChildren(...rows.map(([name, dash, text]) => {
      const key = make("canvas", { width: 68, height: 20 }), c = key.getContext("2d");
      if (name === "ramp") {
        for (let x = 0; x < 68; x++) { c.fillStyle = canvas.colourOf(x / 34 - 1); c.fillRect(x, 6, 1, 8); }
      } else {
        c.strokeStyle = canvas.colour[name];
        c.lineWidth = 5;
        c.setLineDash(dash.map((each) => 2 * each));
        c.beginPath(); c.moveTo(0, 10); c.lineTo(68, 10); c.stroke();
      }
      return make("div", {}, key, text);
    }));
  }

  const takes = {
    about(message) {
      about = message;
      canvas.setAbout(about);
      panel.setAbout(about);
      const rods = about.bases.map((_, i) => [`--rod${i % 4}`, i % 2 ? [5, 3] : [], `motor ${i}`]);
      strips = [new Strip($("rates"), rods, () => (frame && frame.set ? frame.set.rate : about.rate_limit)), new Strip($("error"), [["--trail", [], ""]], null)];
      if (data) $("scrub").max = data.frames.length - 1;
      drawLegend();
    },
    frame(message) {
      frame = message;
      queue.push(message);
      if (queue.length > 3) queue.shift();
    },
    role(message) { role = message; panel.setRole(role); },
    error(message) { panel.banner(message.message); },
    saved(message) { panel.banner(message.problem || `Recorded: ${message.folder}`, 8); },
    workspace(message) { canvas.setWorkspace(message); drawLegend(); },
    ghosts(message) {
      if (message.problem) panel.banner(message.problem);
      canvas.ghosts = message.ghosts || null;
    },
    busy(message) {
      clearTimeout(waiting);
      if (message.on) waiting = setTimeout(() => panel.banner("Getting ready…", 0), 400);
      else if ($("banner").textContent === "Getting ready…") panel.banner("");
    },
    again() { panel.forget(); },
    lost() { panel.banner("The server does not answer; trying again…", 0); lost = true; },
  };
  let lost = false, waiting = 0;

  const on = (message) => {
    if (lost && message.kind !== "lost") { lost = false; panel.banner(""); }
    takes[message.kind](message);
  };
  const link = live ? new Live(on) : new Recording(data, on);
  new Hands(canvas, send, () => ({ frame, live, steers: live && (role.steers || role.free) }));

  $("steer").onclick = () => send({ do: "steer" });
  $("ghosts").onchange = (event) => {
    canvas.show.ghosts = event.target.checked;
    send({ do: "ghosts", on: event.target.checked });
    if (event.target.checked) panel.banner("Looking for all other equilibria…", 4);
  };
  $("workspace").onchange = (event) => { canvas.show.workspace = event.target.checked; canvas.backdrop = null; drawLegend(); };
  $("scrub").oninput = (event) => send({ do: "scrub", i: Number(event.target.value) });

  let planned = false, unread = null, readAt = 0, waited = 0;
  // Figures and strips are read, the robot is watched: a few a second leave it the screen's time.
  function read(now) {
    if (!unread || now - readAt < READ_EVERY) return;
    panel.take(unread);
    for (const strip of strips) strip.draw(canvas.colour);
    if (data) $("scrub").value = unread.n;
    [unread, readAt] = [null, now];
  }

  function turn(now) {
    requestAnimationFrame(turn);
    if (!about) return;
    read(now);
    // Frames that came late in a bunch are all drawn; what then waits for a second is not worth being late for.
    waited = queue.length > 1 ? waited + 1 : 0;
    if (waited > 60) { queue.shift(); waited = 0; }
    const fresh = queue.shift();
    if (!fresh) {
      if (canvas.flashes.length) canvas.draw(canvas.last, now / 1000);
      return;
    }
    for (const event of panel.takeEvents(fresh.events || [])) {
      if (event.p) canvas.flash(event, now / 1000);
      if (["refused", "failure", "recovered"].includes(event.kind)) panel.banner(event.message);
    }
    if (canvas.workspace && fresh.start && canvas.workspace.mode !== fresh.start) { canvas.setWorkspace({}); drawLegend(); }
    canvas.take(fresh, now / 1000);
    const error = fresh.target ? 1000 * Math.hypot(fresh.p[0] - fresh.target[0], fresh.p[1] - fresh.target[1]) : null;
    strips[0].take(fresh.t, fresh.u);
    strips[1].take(fresh.t, [error]);
    unread = fresh;
    if (Boolean(fresh.plan) !== planned) { planned = Boolean(fresh.plan); drawLegend(); }
    window.pcr.frames += 1;
    link.drawn(fresh);
  }
  // What tests and curious people look at.
  window.pcr = { frames: 0, link, canvas, panel, get frame() { return frame; }, get about() { return about; } };
  requestAnimationFrame(turn);
})();
