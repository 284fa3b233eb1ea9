"use strict";
// Replays one episode on two canvases: the world, and a chart of return and cost.
(function () {
  const source = document.getElementById("replay-data");
  if (source) replay(JSON.parse(source.textContent));
  document.body.dataset.ready = "true";

  function bytes(text) { return Uint8Array.from(atob(text), (c) => c.charCodeAt(0)); }
  function shorts(text) { return new Int16Array(bytes(text).buffer); }
  function floats(text) { return new Float32Array(bytes(text).buffer); }

  function decode(data) { // numbers of the frames, and a function that says where a body is
    const codes = shorts(data.poses), moving = new Map(data.moving.map((body, i) => [body, i]));
    function pose(body, frame) { // [x, y, z, qw, qx, qy, qz], or null
      if (!moving.has(body)) { const still = data.still[body]; return still.includes(null) ? null : still; }
      const at = 7 * (frame * moving.size + moving.get(body));
      if (codes[at] === -32768) return null;
      return Array.from(codes.subarray(at, at + 7), (code, i) => code * (i < 3 ? data.scale : 1 / 32767));
    }
    const lidars = data.lidars.map((lidar) => ({ ...lidar, values: bytes(lidar.values) }));
    const numbers = { reward: floats(data.reward), cost: floats(data.cost), violations: shorts(data.violations), goals: shorts(data.goals_met) };
    return { pose, lidars, intrinsic: data.intrinsic && floats(data.intrinsic), ...numbers };
  }

  function sums(values) {
    let sum = 0;
    return Array.from(values, (value) => (sum += value || 0));
  }

  function replay(data) {
    const { add, axes, turn } = view3d;
    const byId = (id) => document.getElementById(id);
    const world = byId("world"), chart = byId("timeline"), button = byId("play"), scrub = byId("scrub");
    const record = decode(data), last = data.frames - 1, dt = data.dt * data.stride;
    const total = { reward: sums(record.reward), cost: sums(record.cost), hits: sums(record.violations), intrinsic: record.intrinsic && sums(record.intrinsic) };
    const path = Array.from({ length: data.frames }, (_, t) => record.pose(data.robot, t));
    const moves = Array.from({ length: data.frames }, (_, t) => t).filter((t) => t && record.goals[t] > record.goals[t - 1]);
    const local = data.shapes.map((shape) => ({ ...shape, axes: axes(shape.quat) }));
    const arena = bounds(), reach = robotReach();
    const still = matchMedia("(prefers-reduced-motion: reduce)");
    const orbit = { azimuth: -1.15, elevation: 0.72, zoom: 1 };
    let frame = 0, position = 0, clock = null, before = 0, started = false, drawing = false, palette = colours();

    function bounds() { // what a camera must hold: the placements, and the path near them
      const [x0, y0, x1, y1] = data.extents, w = x1 - x0, h = y1 - y0;
      let low = [x0, y0], high = [x1, y1];
      for (const p of path) {
        if (!p) continue;
        low = [Math.max(x0 - w, Math.min(low[0], p[0])), Math.max(y0 - h, Math.min(low[1], p[1]))];
        high = [Math.min(x1 + w, Math.max(high[0], p[0])), Math.min(y1 + h, Math.max(high[1], p[1]))];
      }
      return { low, high, x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, half: Math.max(high[0] - low[0], high[1] - low[1]) / 2 + 0.35 };
    }

    function robotReach() { // how far the robot reaches from its origin, from above
      const origin = path[0];
      if (!origin) return 0.2;
      const thing = local.find((shape) => shape.body === data.robot).thing;
      return Math.max(...local.filter((shape) => shape.thing === thing).map((shape) => {
        const p = record.pose(shape.body, 0), c = add(p, turn(axes(p.slice(3)), shape.pos), 1);
        return Math.hypot(c[0] - origin[0], c[1] - origin[1]) + 0.7 * Math.hypot(...shape.size);
      }));
    }

    function colours() {
      const style = getComputedStyle(document.documentElement);
      const names = ["page", "card", "ink", "muted", "grid", "best", "mean", "limit", "third", "floor", "tile", "goal", "hazards", "pillars", "vases", "box", "robot", "trim", "wheel"];
      return Object.fromEntries(names.map((name) => [name, style.getPropertyValue("--" + name).trim()]));
    }

    function rgb(name) {
      const hex = palette[name] || palette.ink;
      return [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16));
    }

    function prepare(canvas) { // matches the bitmap to the screen's pixels
      const ratio = window.devicePixelRatio || 1;
      const width = canvas.clientWidth, height = canvas.clientHeight;
      const w = Math.round(width * ratio), h = Math.round(height * ratio);
      if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
      const pen = canvas.getContext("2d");
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      pen.lineJoin = "round";
      return { pen, width, height };
    }

    // ---- where things are

    function poseNow(body) { // between two frames, except for the goal, which jumps
      const p = record.pose(body, frame), share = position - frame;
      if (!p || body === data.goal || frame >= last || share <= 0) return p;
      const q = record.pose(body, frame + 1);
      if (!q) return p;
      const sign = p[3] * q[3] + p[4] * q[4] + p[5] * q[5] + p[6] * q[6] < 0 ? -1 : 1;
      const mixed = p.map((value, i) => value + share * ((i < 3 ? q[i] : sign * q[i]) - value));
      const norm = Math.hypot(...mixed.slice(3)) || 1;
      return mixed.map((value, i) => (i < 3 ? value : value / norm));
    }

    function things() { // solids by thing: Map from its number to { look, solids }
      const poses = new Map(), out = new Map();
      for (const shape of local) {
        if (!poses.has(shape.body)) {
          const p = poseNow(shape.body);
          poses.set(shape.body, p && { p, columns: axes(p.slice(3)) });
        }
        const body = poses.get(shape.body);
        if (!body) continue;
        const solid = { kind: shape.kind, size: shape.size, outline: shape.outline, look: shape.look, rgb: rgb(shape.look) };
        solid.c = add(body.p, turn(body.columns, shape.pos), 1);
        solid.a = shape.axes.map((axis) => turn(body.columns, axis));
        if (!out.has(shape.thing)) out.set(shape.thing, { look: shape.look, solids: [], p: body.p });
        out.get(shape.thing).solids.push(solid);
      }
      return [...out.values()];
    }

    function camera(width, height) {
      const kind = byId("view").value;
      if (kind === "top") return view3d.topCamera(arena.x, arena.y, arena.half / orbit.zoom, width, height);
      const make = (target, distance) => view3d.orbitCamera(target, orbit.azimuth, orbit.elevation, distance / orbit.zoom, width, height);
      if (kind === "follow") {
        const [x, y] = smooth(frame);
        return make([x, y, 0.1], 3.2 + 3.5 * reach);
      }
      let distance = 1; // far enough to hold the four corners
      const corners = [arena.low, arena.high].flatMap(([x]) => [arena.low, arena.high].map(([, y]) => [x, y, 0]));
      const holds = (eye) => corners.every((corner) => { const p = eye.project(corner); return p && p[0] > 14 && p[0] < width - 14 && p[1] > 14 && p[1] < height - 14; });
      const free = (d) => view3d.orbitCamera([arena.x, arena.y, 0], orbit.azimuth, orbit.elevation, d, width, height);
      while (distance < 60 && !holds(free(distance))) distance *= 1.03;
      return make([arena.x, arena.y, 0], distance);
    }

    function smooth(t) { // the robot's place, averaged over about a second, so that the camera glides
      const reach = Math.max(1, Math.round(0.6 / dt)), share = position - t;
      let x = 0, y = 0, weight = 0;
      for (let i = t - reach; i <= t + reach + 1; i++) {
        const p = path[Math.min(last, Math.max(0, i))];
        if (!p) continue;
        const w = Math.max(0, 1 - Math.abs(i - t - share) / (reach + 1));
        x += w * p[0]; y += w * p[1]; weight += w;
      }
      return weight ? [x / weight, y / weight] : [arena.x, arena.y];
    }

    // ---- drawing

    function drawWorld() {
      const { pen, width, height } = prepare(world), eye = camera(width, height);
      pen.fillStyle = palette.page; pen.fillRect(0, 0, width, height);
      drawFloor(pen, eye);
      const all = things(), solid = all.filter((thing) => thing.look !== "goal" && thing.look !== "hazards");
      for (const thing of all.filter((one) => one.look === "hazards")) {
        const [x, y] = thing.p;
        view3d.polygon(pen, eye, view3d.circle(x, y, 0.001, thing.solids[0].size[0]), { fill: palette.hazards, alpha: 0.34, stroke: palette.hazards, width: 1.5 });
      }
      const goal = all.find((thing) => thing.look === "goal");
      if (goal) drawGoalBase(pen, eye, goal);
      if (byId("show-trail").checked) drawTrail(pen, eye);
      view3d.drawShadows(pen, eye, solid.flatMap((thing) => thing.solids), 0.2);
      const flash = violationNow();
      const robot = poseNow(data.robot);
      if (robot && flash > 0) view3d.polygon(pen, eye, view3d.circle(robot[0], robot[1], 0.002, reach + 0.06), { fill: palette.limit, alpha: 0.45 * flash });
      if (robot && byId("show-lidar").checked) drawLidars(pen, eye, robot);
      drawSolids(pen, eye, solid, goal, robot);
      if (flash > 0) {
        pen.globalAlpha = flash; pen.strokeStyle = palette.limit; pen.lineWidth = 8;
        pen.strokeRect(4, 4, width - 8, height - 8); pen.globalAlpha = 1;
      }
    }

    function violationNow() { // 1 in a violation, fading over a third of a second after it
      const hold = Math.max(1, Math.round(0.35 / dt));
      for (let age = 0; age < hold && frame - age >= 0; age++) if (record.violations[frame - age] > 0) return 1 - age / hold;
      return 0;
    }

    function drawFloor(pen, eye) {
      const size = arena.half > 5 ? 1 : 0.5, more = 1 + 0.3 * arena.half;
      const [x0, x1] = [arena.low[0] - more, arena.high[0] + more].map((x, i) => Math[i ? "ceil" : "floor"](x / size));
      const [y0, y1] = [arena.low[1] - more, arena.high[1] + more].map((y, i) => Math[i ? "ceil" : "floor"](y / size));
      const square = (a, b, c, d) => [[a, b, 0], [c, b, 0], [c, d, 0], [a, d, 0]];
      for (let i = x0; i < x1; i++) for (let j = y0; j < y1; j++) {
        const fill = (i + j) & 1 ? palette.tile : palette.floor;
        view3d.polygon(pen, eye, square(i * size, j * size, (i + 1) * size, (j + 1) * size), { fill, stroke: fill, width: 0.6 });
      }
      const [a, b, c, d] = data.extents;
      view3d.polygon(pen, eye, square(a, b, c, d), { stroke: palette.muted, width: 1.2, line: 0.55 });
    }

    function drawGoalBase(pen, eye, goal) {
      const [x, y] = goal.p, r = goal.solids[0].size[0];
      view3d.polygon(pen, eye, view3d.circle(x, y, 0.001, r), { fill: palette.goal, alpha: 0.38, stroke: palette.goal, width: 1.5 });
      const met = moves.filter((t) => t <= frame).pop(); // a ring spreads where a goal was met
      const age = met === undefined ? 1 : (position - met) * dt / 0.7;
      const old = age < 1 && record.pose(data.goal, met - 1);
      if (old) view3d.polygon(pen, eye, view3d.circle(old[0], old[1], 0.001, r * (1 + age)), { stroke: palette.goal, width: 3, line: 1 - age });
    }

    function drawTrail(pen, eye) {
      const seen = (t) => path[t] && eye.project([path[t][0], path[t][1], 0.003]);
      let from = seen(0), run = null;
      for (let t = 1; t <= frame; t++) {
        const to = seen(t), hit = record.violations[t] > 0, alpha = hit ? 0.95 : Math.max(0.16, 0.7 - Math.floor((frame - t) * dt) / 12);
        if (!run || run.hit !== hit || run.alpha !== alpha || !from || !to) {
          if (run) pen.stroke();
          run = { hit, alpha };
          pen.beginPath();
          pen.strokeStyle = hit ? palette.limit : palette.muted; pen.lineWidth = hit ? 3 : 2; pen.globalAlpha = alpha;
          if (from) pen.moveTo(from[0], from[1]);
        }
        if (from && to) pen.lineTo(to[0], to[1]);
        from = to;
      }
      if (run) pen.stroke();
      pen.globalAlpha = 1;
    }

    function drawLidars(pen, eye, robot) {
      const columns = axes(robot.slice(3)), width = 0.075, z = 0.004;
      const along = (angle, r) => { // a direction of the robot's frame, laid on the floor
        const v = turn(columns, [Math.cos(angle), Math.sin(angle), 0]), n = Math.hypot(v[0], v[1]) || 1;
        return [robot[0] + (r * v[0]) / n, robot[1] + (r * v[1]) / n, z];
      };
      record.lidars.forEach((lidar, k) => {
        const inner = reach + 0.07 + k * (width + 0.02), step = (2 * Math.PI) / lidar.bins;
        for (let bin = 0; bin < lidar.bins; bin++) {
          const reading = lidar.values[frame * lidar.bins + bin] / 255, parts = 32 / lidar.bins + 1;
          const at = (i) => (bin + 0.05 + (0.9 * i) / parts) * step, edge = (r) => Array.from({ length: parts + 1 }, (_, i) => along(at(i), r));
          const points = edge(inner).concat(edge(inner + width).reverse());
          view3d.polygon(pen, eye, points, { fill: palette[lidar.name], alpha: reading ? 0.12 + 0.88 * Math.sqrt(reading) : 0, stroke: palette.muted, width: 0.7, line: 0.45 });
        }
      });
      const tip = reach + 0.05 + record.lidars.length * (width + 0.02) + 0.02; // a mark says where it is headed
      view3d.polygon(pen, eye, [along(data.heading, tip + 0.09), along(data.heading - 0.13, tip), along(data.heading + 0.13, tip)], { fill: palette.ink, alpha: 0.75 });
    }

    // Things stand side by side: circles on the floor, of which the one whose tangent
    // from the eye is longer is behind. A see-through goal has a far and a near half.
    function drawSolids(pen, eye, solid, goal, robot) {
      const far = (x, y, r) => (x - eye.eye[0]) ** 2 + (y - eye.eye[1]) ** 2 - r * r;
      const jobs = solid.map((thing) => {
        const [x, y] = thing.p, r = thing.look === "robot" || thing.look === "trim" ? reach : footprint(thing.solids[0]);
        return { key: eye.flat ? -thing.p[2] : far(x, y, r), draw: () => view3d.drawThing(pen, eye, thing.solids, hides(eye, thing, robot) ? 0.35 : 1) };
      });
      if (goal) {
        const [x, y] = goal.p, r = goal.solids[0].size[0], d = Math.hypot(x - eye.eye[0], y - eye.eye[1]);
        const half = (near) => () => drawGoalWall(pen, eye, goal, near);
        if (eye.flat) jobs.push({ key: 1e9, draw: half(true) });
        else jobs.push({ key: (d + r) ** 2, draw: half(false) }, { key: Math.max(0, d - r) ** 2, draw: half(true) });
      }
      for (const job of jobs.sort((p, q) => q.key - p.key)) job.draw();
    }

    function hides(eye, thing, robot) { // whether a pillar stands between the eye and the robot
      if (eye.flat || !robot || thing.look !== "pillars") return false;
      const [x, y] = [robot[0] - eye.eye[0], robot[1] - eye.eye[1]], [u, v] = [thing.p[0] - eye.eye[0], thing.p[1] - eye.eye[1]];
      const norm = Math.hypot(x, y), share = (u * x + v * y) / norm ** 2;
      return share > 0 && share < 1 && Math.abs(u * y - v * x) / norm < thing.solids[0].size[0] + 0.1;
    }

    function footprint(s) {
      if (s.kind === "prism") return Math.max(...s.outline.map((c) => Math.hypot(c[0], c[1]))) * 0.8;
      return s.kind === "box" ? s.size[0] * 1.2 : s.size[0];
    }

    function drawGoalWall(pen, eye, goal, near) {
      const s = goal.solids[0], [x, y, z] = s.c, low = view3d.circle(x, y, z - s.size[1], s.size[0]), high = view3d.circle(x, y, z + s.size[1], s.size[0]);
      low.forEach((p, i) => {
        const j = (i + 1) % low.length, normal = [p[0] - x, p[1] - y, 0];
        if (eye.flat || view3d.faces(eye, p, normal) !== near) return;
        view3d.polygon(pen, eye, [p, low[j], high[j], high[i]], { fill: palette.goal, alpha: near ? 0.3 : 0.22 });
        view3d.polygon(pen, eye, [high[i], high[j]], { stroke: palette.goal, width: 1.5 });
      });
    }

    // ---- the chart

    function drawChart() {
      const { pen, width, height } = prepare(chart), at = (t) => 2 + (t / Math.max(1, last)) * (width - 4);
      pen.fillStyle = palette.page; pen.fillRect(0, 0, width, height);
      const worst = Math.max(1e-9, ...record.cost);
      pen.fillStyle = palette.limit; pen.globalAlpha = 0.45;
      for (let t = 1; t <= last; t++) if (record.cost[t] > 0) pen.fillRect(at(t) - 0.5, height, Math.max(1.2, (width / last) * 0.9), -(height - 18) * (0.1 + (0.3 * record.cost[t]) / worst));
      pen.globalAlpha = 1;
      if (record.intrinsic) line(pen, record.intrinsic.map((v, t) => (t ? v : NaN)), palette.third, 1, 0); // frame 0 has no step
      line(pen, total.cost, palette.limit, 1.6, 0);
      line(pen, total.reward, palette.best, 2, Math.min(0, ...total.reward));
      pen.fillStyle = palette.goal;
      for (const t of moves) { pen.beginPath(); pen.arc(at(t), 7, 3.2, 0, 2 * Math.PI); pen.fill(); }
      pen.fillStyle = palette.ink; pen.fillRect(Math.min(at(frame) - 0.75, width - 2), 0, 1.5, height);

      function line(pen, values, colour, thick, low) {
        const high = Math.max(low + 1e-9, ...Array.from(values, (v) => v || 0)), y = (v) => height - 4 - ((v - low) / (high - low)) * (height - 20);
        pen.strokeStyle = colour; pen.lineWidth = thick; pen.beginPath();
        let down = false;
        values.forEach((v, t) => {
          if (Number.isFinite(v)) { if (down) pen.lineTo(at(t), y(v)); else pen.moveTo(at(t), y(v)); }
          down = Number.isFinite(v);
        });
        pen.stroke();
      }
    }

    // ---- the controls

    function show(next) {
      position = Math.min(last, Math.max(0, next));
      frame = Math.floor(position);
      const step = Math.min(data.steps, frame * data.stride), time = (step * data.dt).toFixed(1) + " s";
      world.dataset.frame = String(frame); world.dataset.view = byId("view").value;
      if (Number(scrub.value) !== frame) scrub.value = String(frame);
      scrub.setAttribute("aria-valuetext", "step " + step + ", " + time);
      const text = (id, value, digits) => { const place = byId(id); if (place) place.textContent = Number.isFinite(value) ? value.toFixed(digits) : "–"; };
      byId("now-step").textContent = step + " of " + data.steps;
      byId("now-time").textContent = time;
      text("now-return", total.reward[frame], 2); text("now-reward", record.reward[frame], 3);
      text("now-cost", total.cost[frame], 3); text("now-step-cost", record.cost[frame], 3);
      text("now-hits", total.hits[frame], 0); text("now-goals", record.goals[frame], 0);
      if (record.intrinsic) { text("now-intrinsic", total.intrinsic[frame], 2); text("now-step-intrinsic", record.intrinsic[frame], 4); }
      byId("now-cost").classList.toggle("hit", total.cost[frame] > 0);
      byId("now-step-cost").classList.toggle("hit", record.cost[frame] > 0);
      if (!drawing) requestAnimationFrame(() => { drawing = false; drawWorld(); drawChart(); });
      drawing = true;
    }

    // A timer moves the episode on, whatever the frame rate; drawing waits for a frame.
    function tick() {
      const now = performance.now();
      const next = position + (Math.min(now - before, 200) / 1000 / dt) * Number(byId("speed").value);
      before = now;
      show(next);
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

    function jump(next) { started = true; show(next); }

    function keys(event) {
      const step = { ArrowRight: 1, ArrowLeft: -1, PageDown: 25, PageUp: -25 }[event.key];
      if (event.key === " ") setPlaying(clock === null);
      else if (step) jump(frame + step);
      else if (event.key === "+" || event.key === "-") { zoom(event.key === "+" ? 1.15 : 1 / 1.15); }
      else return;
      event.preventDefault();
    }

    function zoom(by) { orbit.zoom = Math.min(6, Math.max(0.4, orbit.zoom * by)); show(position); }

    function drag(event) {
      if (!(event.buttons & 1) || byId("view").value === "top") return;
      orbit.azimuth -= 0.008 * event.movementX;
      orbit.elevation = Math.min(1.5, Math.max(0.08, orbit.elevation + 0.006 * event.movementY));
      started = true; show(position);
    }

    function obeyAddress() { // #replay plays; #step=300&view=top shows one moment
      const wish = new URLSearchParams(location.hash.slice(1));
      const kind = wish.get("view"), step = Number(wish.get("step"));
      if (["top", "3d", "follow"].includes(kind)) byId("view").value = kind;
      if (wish.has("step") && Number.isFinite(step)) jump(step / data.stride);
      if (wish.has("replay")) setPlaying(true);
    }

    button.addEventListener("click", () => setPlaying(clock === null));
    scrub.addEventListener("input", () => jump(Number(scrub.value)));
    chart.addEventListener("click", (event) => jump(Math.round((event.offsetX / chart.clientWidth) * last)));
    for (const id of ["view", "show-lidar", "show-trail"]) byId(id).addEventListener("change", () => show(position));
    world.addEventListener("keydown", keys);
    world.addEventListener("pointermove", drag);
    world.addEventListener("pointerdown", (event) => world.setPointerCapture(event.pointerId));
    world.addEventListener("wheel", (event) => { if (event.ctrlKey || event.metaKey) { event.preventDefault(); zoom(Math.exp(-0.002 * event.deltaY)); } }, { passive: false });
    window.addEventListener("resize", () => show(position));
    window.addEventListener("hashchange", obeyAddress);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { palette = colours(); show(position); });
    new IntersectionObserver((entries) => { // starts by itself once, when it is seen
      if (entries.some((entry) => entry.isIntersecting) && !started && !still.matches) setPlaying(true);
    }, { threshold: 0.4 }).observe(world);
    show(0);
    obeyAddress();
  }
})();
