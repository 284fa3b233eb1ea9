"use strict";
// Replays one episode on two canvases: the world seen from above, and a timeline.
(function () {
  const source = document.getElementById("replay-data");
  if (source) replay(JSON.parse(source.textContent));
  document.body.dataset.ready = "true";

  function replay(data) {
    const byId = (id) => document.getElementById(id);
    const world = byId("world"), timeline = byId("timeline");
    const button = byId("play"), scrub = byId("scrub"), speed = byId("speed");
    const steps = data.cost.length, last = steps - 1;
    const total = { reward: sums(data.reward), cost: sums(data.cost), intrinsic: sums(data.intrinsic) };
    const hits = sums(data.cost.map((c) => (c > 0 ? 1 : 0)));
    const goals = sums(data.goal_xy.map((g, t) => (t && (g[0] !== data.goal_xy[t - 1][0] || g[1] !== data.goal_xy[t - 1][1]) ? 1 : 0)));
    const peak = Math.max(1e-9, ...data.intrinsic.map((c) => c || 0));
    const worst = Math.max(1e-9, ...data.cost.map((c) => c || 0));
    const view = bounds();
    const still = matchMedia("(prefers-reduced-motion: reduce)");
    let frame = 0, position = 0, clock = null, before = 0, started = false, drawing = false, palette = colours();

    function sums(values) {
      let sum = 0;
      return values.map((value) => (sum += value || 0));
    }

    function bounds() { // a square that holds the placements and the whole path
      let [x0, y0, x1, y1] = data.extents;
      for (const [x, y] of data.robot_xy.concat(data.goal_xy, data.hazards)) {
        if (x === null || y === null) continue;
        x0 = Math.min(x0, x); x1 = Math.max(x1, x); y0 = Math.min(y0, y); y1 = Math.max(y1, y);
      }
      const half = Math.max(x1 - x0, y1 - y0) / 2 + data.hazard_radius;
      return { x: (x0 + x1) / 2, y: (y0 + y1) / 2, half };
    }

    function colours() {
      const style = getComputedStyle(document.documentElement);
      const names = ["page", "card", "ink", "muted", "grid", "best", "mean", "limit", "goal", "hazard"];
      return Object.fromEntries(names.map((name) => [name, style.getPropertyValue("--" + name).trim()]));
    }

    function prepare(canvas) { // matches the bitmap to the screen's pixels
      const ratio = window.devicePixelRatio || 1;
      const width = canvas.clientWidth, height = canvas.clientHeight;
      const w = Math.round(width * ratio), h = Math.round(height * ratio);
      if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
      const pen = canvas.getContext("2d");
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.clearRect(0, 0, width, height);
      return { pen, width, height };
    }

    function disc(pen, x, y, r, colour, alpha) {
      pen.beginPath(); pen.arc(x, y, r, 0, 2 * Math.PI);
      pen.globalAlpha = alpha; pen.fillStyle = colour; pen.fill();
      pen.globalAlpha = 1; pen.strokeStyle = colour; pen.lineWidth = 1.5; pen.stroke();
    }

    function drawWorld() {
      const { pen, width } = prepare(world);
      const scale = width / (2 * view.half);
      const px = (x) => (x - view.x + view.half) * scale, py = (y) => (view.y + view.half - y) * scale;
      pen.fillStyle = palette.page; pen.fillRect(0, 0, width, width);
      const [x0, y0, x1, y1] = data.extents;
      pen.strokeStyle = palette.grid; pen.lineWidth = 1.5;
      pen.strokeRect(px(x0), py(y1), (x1 - x0) * scale, (y1 - y0) * scale);
      for (const [x, y] of data.hazards) disc(pen, px(x), py(y), data.hazard_radius * scale, palette.hazard, 0.28);
      const goal = data.goal_xy[frame];
      if (goal[0] !== null) disc(pen, px(goal[0]), py(goal[1]), data.goal_radius * scale, palette.goal, 0.35);
      if (data.box_xy && data.box_xy[frame][0] !== null) {
        const half = data.box_size * scale, [bx, by] = data.box_xy[frame];
        pen.fillStyle = palette.mean; pen.fillRect(px(bx) - half, py(by) - half, 2 * half, 2 * half);
      }
      trail(pen, px, py);
      const [x, y] = data.robot_xy[frame], yaw = data.robot_yaw[frame];
      if (x !== null && y !== null && yaw !== null) robot(pen, px(x), py(y), yaw, scale);
      if (data.cost[frame] > 0) {
        pen.strokeStyle = palette.limit; pen.lineWidth = 8; pen.strokeRect(4, 4, width - 8, width - 8);
      }
    }

    function trail(pen, px, py) {
      pen.lineWidth = 2; pen.lineJoin = "round";
      for (let t = 1; t <= frame; t++) {
        const a = data.robot_xy[t - 1], b = data.robot_xy[t];
        if (a[0] === null || b[0] === null) continue;
        const hit = data.cost[t] > 0;
        pen.globalAlpha = hit ? 1 : Math.max(0.14, 0.75 - (frame - t) / 400);
        pen.strokeStyle = hit ? palette.limit : palette.muted;
        pen.beginPath(); pen.moveTo(px(a[0]), py(a[1])); pen.lineTo(px(b[0]), py(b[1])); pen.stroke();
      }
      pen.globalAlpha = 1;
    }

    function robot(pen, x, y, yaw, scale) {
      const lidar = data.constraint_lidar[frame], width = (2 * Math.PI) / lidar.length;
      const inner = 0.2 * scale, ring = 0.15 * scale;
      lidar.forEach((reading, bin) => { // canvas angles run clockwise: y points down
        const from = -(yaw + bin * width) - 0.04, to = -(yaw + (bin + 1) * width) + 0.04;
        pen.beginPath(); pen.arc(x, y, inner + ring, from, to, true); pen.arc(x, y, inner, to, from, false); pen.closePath();
        pen.strokeStyle = palette.muted; pen.lineWidth = 0.7; pen.stroke();
        pen.globalAlpha = Math.min(1, Math.max(0, reading || 0)); pen.fillStyle = palette.hazard; pen.fill();
        pen.globalAlpha = 1;
      });
      const size = 0.14 * scale;
      pen.save(); pen.translate(x, y); pen.rotate(-yaw);
      pen.beginPath(); pen.moveTo(size * 1.15, 0); pen.lineTo(-size * 0.8, size * 0.8); pen.lineTo(-size * 0.4, 0); pen.lineTo(-size * 0.8, -size * 0.8); pen.closePath();
      pen.fillStyle = data.cost[frame] > 0 ? palette.limit : palette.ink; pen.fill();
      pen.restore();
    }

    function drawTimeline() {
      const { pen, width, height } = prepare(timeline);
      const at = (t) => (t / Math.max(1, last)) * width;
      pen.fillStyle = palette.page; pen.fillRect(0, 0, width, height);
      pen.fillStyle = palette.limit;
      data.cost.forEach((cost, t) => { if (cost > 0) pen.fillRect(at(t) - 0.5, height, 2, -height * (0.25 + (0.75 * cost) / worst)); });
      pen.strokeStyle = palette.best; pen.lineWidth = 1.4; pen.beginPath();
      let down = false;
      data.intrinsic.forEach((cost, t) => {
        if (cost === null) { down = false; return; }
        const y = height - 3 - (cost / peak) * (height - 8);
        if (down) pen.lineTo(at(t), y); else pen.moveTo(at(t), y);
        down = true;
      });
      pen.stroke();
      pen.fillStyle = palette.ink; pen.fillRect(Math.min(at(frame), width - 2), 0, 2, height);
    }

    function show(next) {
      frame = Math.min(last, Math.max(0, Math.floor(next)));
      world.dataset.frame = String(frame);
      if (Number(scrub.value) !== frame) scrub.value = String(frame);
      scrub.setAttribute("aria-valuetext", "step " + (frame + 1) + ", " + seconds(frame));
      const number = (value, digits) => (value === null ? "–" : value.toFixed(digits));
      byId("now-step").textContent = frame + 1 + " of " + steps;
      byId("now-time").textContent = seconds(frame);
      byId("now-return").textContent = number(total.reward[frame], 2);
      byId("now-cost").textContent = number(total.cost[frame], 3);
      byId("now-hits").textContent = String(hits[frame]);
      byId("now-intrinsic").textContent = number(total.intrinsic[frame], 2);
      byId("now-step-intrinsic").textContent = number(data.intrinsic[frame], 4);
      byId("now-goals").textContent = String(goals[frame]);
      byId("now-cost").classList.toggle("hit", total.cost[frame] > 0);
      if (!drawing) requestAnimationFrame(() => { drawing = false; drawWorld(); drawTimeline(); });
      drawing = true;
    }

    function seconds(t) { return ((t + 1) * data.dt).toFixed(1) + " s"; }

    // A timer moves the episode on, whatever the frame rate; drawing waits for a frame.
    function tick() {
      const now = performance.now();
      position += (Math.min(now - before, 200) / 1000 / data.dt) * Number(speed.value);
      before = now;
      show(position);
      if (frame >= last) setPlaying(false);
    }

    function setPlaying(on) {
      if (on && frame >= last) position = 0;
      clearInterval(clock);
      before = performance.now();
      clock = on ? setInterval(tick, 1000 / 60) : null;
      started = true;
      button.textContent = on ? "Pause" : "Play";
    }

    button.addEventListener("click", () => setPlaying(clock === null));
    scrub.addEventListener("input", () => { position = Number(scrub.value); started = true; show(position); });
    timeline.addEventListener("click", (event) => { position = (event.offsetX / timeline.clientWidth) * last; started = true; show(position); });
    window.addEventListener("resize", () => show(frame));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { palette = colours(); show(frame); });
    new IntersectionObserver((entries) => { // starts by itself once, when it is seen
      if (entries.some((entry) => entry.isIntersecting) && !started && !still.matches) setPlaying(true);
    }, { threshold: 0.4 }).observe(world);
    show(0);
    if (location.hash === "#replay") setPlaying(true); // a link that starts the replay
  }
})();
