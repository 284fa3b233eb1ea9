"use strict";
// Replays recorded episodes: one, or two beside each other under one slider. Each has a
// canvas of the world and a chart of return and cost.
(function () {
  const { add, axes, turn } = view3d;
  const source = document.getElementById("replay-data");
  if (source) play(JSON.parse(source.textContent));
  document.body.dataset.ready = "true";

  function byId(id) { return document.getElementById(id); }
  function bytes(text) { return Uint8Array.from(atob(text), (c) => c.charCodeAt(0)); }
  function shorts(text) { return new Int16Array(bytes(text).buffer); }
  function floats(text) { return new Float32Array(bytes(text).buffer); }

  function sums(values) {
    let sum = 0;
    return Array.from(values, (value) => (sum += value || 0));
  }

  // ---- a recorded episode

  function decode(data) { // its numbers, and a function that says where a body is in a frame
    const codes = shorts(data.poses), moving = new Map(data.moving.map((body, i) => [body, i]));
    const last = data.frames - 1, frames = Array.from({ length: data.frames }, (_, t) => t);
    function pose(body, frame) { // [x, y, z, qw, qx, qy, qz], or null
      if (!moving.has(body)) { const still = data.still[body]; return still.includes(null) ? null : still; }
      const at = 7 * (frame * moving.size + moving.get(body));
      if (codes[at] === -32768) return null;
      return Array.from(codes.subarray(at, at + 7), (code, i) => code * (i < 3 ? data.scale : 1 / 32767));
    }
    const numbers = { reward: floats(data.reward), cost: floats(data.cost), violations: shorts(data.violations), goals: shorts(data.goals_met), intrinsic: data.intrinsic && floats(data.intrinsic) };
    const total = { reward: sums(numbers.reward), cost: sums(numbers.cost), hits: sums(numbers.violations), intrinsic: numbers.intrinsic && sums(numbers.intrinsic) };
    const lidars = data.lidars.map((lidar) => ({ ...lidar, values: bytes(lidar.values) }));
    const path = frames.map((t) => pose(data.robot, t));
    const box = data.shapes.find((shape) => shape.look === "box");
    const boxPath = box ? frames.map((t) => pose(box.body, t)) : null;
    const outside = path.map((p) => (p ? beyond(p, data.extents) : NaN)); // metres past the border
    const timeOutside = sums(outside.map((d, t) => (t && d > 0 ? 1 : 0)));
    const moves = frames.filter((t) => t && numbers.goals[t] > numbers.goals[t - 1]);
    const shapes = data.shapes.map((shape) => ({ ...shape, axes: axes(shape.quat) }));
    const record = { ...data, ...numbers, total, lidars, pose, path, boxPath, outside, timeOutside, moves, shapes, last, frameTime: data.dt * data.stride };
    record.reach = robotReach(record);
    record.seen = bounds(record);
    record.all = record.seen[last];
    return record;
  }

  function beyond([x, y], [x0, y0, x1, y1]) { return Math.hypot(Math.max(x0 - x, 0, x - x1), Math.max(y0 - y, 0, y - y1)); }

  function bounds(record) { // by frame, what a view must hold: the arena, and all paths so far
    const [x0, y0, x1, y1] = record.extents, low = [x0, y0], high = [x1, y1];
    return record.path.map((robot, t) => {
      for (const p of [robot, record.boxPath && record.boxPath[t]]) {
        if (p) for (const i of [0, 1]) { low[i] = Math.min(low[i], p[i]); high[i] = Math.max(high[i], p[i]); }
      }
      return { low: [...low], high: [...high], x: (low[0] + high[0]) / 2, y: (low[1] + high[1]) / 2, half: Math.max(high[0] - low[0], high[1] - low[1]) / 2 + 0.35 };
    });
  }

  function robotReach(record) { // how far the robot reaches from its origin, from above
    const origin = record.path[0];
    if (!origin) return 0.2;
    const thing = record.shapes.find((shape) => shape.body === record.robot).thing;
    return Math.max(...record.shapes.filter((shape) => shape.thing === thing).map((shape) => {
      const p = record.pose(shape.body, 0), c = add(p, turn(axes(p.slice(3)), shape.pos), 1);
      return Math.hypot(c[0] - origin[0], c[1] - origin[1]) + 0.7 * Math.hypot(...shape.size);
    }));
  }

  // ---- the player: one clock, one camera and one set of controls for its panes

  function play(list) {
    const button = byId("play"), scrub = byId("scrub"), records = [];
    const still = matchMedia("(prefers-reduced-motion: reduce)");
    const shared = { azimuth: -1.15, elevation: 0.66, zoom: 1, palette: colours(), scale: null };
    const panes = [0, 1].filter((i) => byId("pane-" + i)).map((i) => makePane(i, shared));
    let position = 0, end = 1, clock = null, before = 0, started = false, drawing = false;

    function record(index) { return records[index] || (records[index] = decode(list[index])); }

    function colours() {
      const style = getComputedStyle(document.documentElement);
      const names = ["page", "card", "ink", "muted", "grid", "best", "mean", "limit", "third", "floor", "tile", "goal", "hazards", "pillars", "vases", "box", "robot", "trim", "wheel", "sans"];
      return Object.fromEntries(names.map((name) => [name, style.getPropertyValue("--" + name).trim()]));
    }

    function choose() { // the panes show what their lists say; -1 is nothing
      for (const pane of panes) {
        const index = pane.pick ? Number(pane.pick.value) : 0;
        pane.show(index < 0 ? null : record(index));
      }
      const open = panes.filter((pane) => pane.record);
      byId("panes").classList.toggle("one", open.length < 2);
      end = Math.max(1, ...open.map((pane) => steps(pane.record)));
      // One scale for both charts, so that heights can be compared.
      const top = (values) => Math.max(1e-9, ...open.flatMap((pane) => values(pane.record)).map((v) => v || 0));
      shared.scale = {
        steps: end, step: stepTime(),
        reward: [Math.min(0, ...open.flatMap((pane) => pane.record.total.reward)), top((r) => r.total.reward)],
        cost: top((r) => r.total.cost), now: top((r) => Array.from(r.cost)), intrinsic: top((r) => Array.from(r.intrinsic || [])),
      };
      scrub.max = String(Math.round(end));
      scrub.step = String(Math.max(...open.map((pane) => pane.record.stride)) === 1 ? 1 : "any");
      show(position);
    }

    function stepTime() { return panes[0].record.dt; }
    function steps(one) { return (one.steps * one.dt) / stepTime(); } // in steps of the first

    function show(next) { // position counts steps of the first pane's episode
      position = Math.min(end, Math.max(0, next));
      const step = Math.floor(position + 1e-9), time = (position * stepTime()).toFixed(1) + " s";
      if (Math.floor(Number(scrub.value)) !== step) scrub.value = String(step);
      scrub.setAttribute("aria-valuetext", "step " + step + ", " + time);
      byId("now-step").textContent = "step " + step + " of " + Math.round(end);
      byId("now-time").textContent = time;
      for (const pane of panes) if (pane.record) pane.seek((position * stepTime()) / pane.record.dt);
      if (!drawing) requestAnimationFrame(() => { drawing = false; for (const pane of panes) if (pane.record) pane.draw(); });
      drawing = true;
    }

    // A timer moves the episode on, whatever the frame rate; drawing waits for a frame.
    function tick() {
      const now = performance.now();
      const next = position + (Math.min(now - before, 200) / 1000 / stepTime()) * Number(byId("speed").value);
      before = now;
      show(next);
      if (position >= end) setPlaying(false);
    }

    function setPlaying(on) {
      if (on && position >= end) position = 0;
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
      else if (step) jump(Math.floor(position + 1e-9) + step * panes[0].record.stride);
      else if (event.key === "+" || event.key === "-") zoom(event.key === "+" ? 1.15 : 1 / 1.15);
      else return;
      event.preventDefault();
    }

    function zoom(by) { shared.zoom = Math.min(8, Math.max(0.15, shared.zoom * by)); show(position); }

    function drag(event) {
      if (!(event.buttons & 1) || byId("view").value === "top") return;
      shared.azimuth -= 0.008 * event.movementX;
      shared.elevation = Math.min(1.5, Math.max(0.08, shared.elevation + 0.006 * event.movementY));
      started = true; show(position);
    }

    function obeyAddress() { // #replay plays; #step=300&view=top shows one moment
      const wish = new URLSearchParams(location.hash.slice(1));
      const kind = wish.get("view"), step = Number(wish.get("step"));
      if (["follow", "3d", "top"].includes(kind)) byId("view").value = kind;
      if (wish.has("step") && Number.isFinite(step)) jump(step);
      if (wish.has("replay")) setPlaying(true);
    }

    button.addEventListener("click", () => setPlaying(clock === null));
    scrub.addEventListener("input", () => jump(Number(scrub.value)));
    for (const id of ["show-lidar", "show-trail"]) byId(id).addEventListener("change", () => show(position));
    byId("view").addEventListener("change", () => { shared.zoom = 1; show(position); });
    for (const pane of panes) {
      if (pane.pick) pane.pick.addEventListener("change", choose);
      pane.chart.addEventListener("click", (event) => jump(Math.round((event.offsetX / pane.chart.clientWidth) * end)));
      pane.world.addEventListener("keydown", keys);
      pane.world.addEventListener("pointermove", drag);
      pane.world.addEventListener("pointerdown", (event) => pane.world.setPointerCapture(event.pointerId));
      pane.world.addEventListener("wheel", (event) => { if (event.ctrlKey || event.metaKey) { event.preventDefault(); zoom(Math.exp(-0.002 * event.deltaY)); } }, { passive: false });
    }
    window.addEventListener("resize", () => show(position));
    window.addEventListener("hashchange", obeyAddress);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { shared.palette = colours(); show(position); });
    new IntersectionObserver((entries) => { // starts by itself once, when it is seen
      if (entries.some((entry) => entry.isIntersecting) && !started && !still.matches) setPlaying(true);
    }, { threshold: 0.4 }).observe(panes[0].world);
    choose();
    obeyAddress();
  }

  // ---- a pane: one episode, drawn

  function makePane(number, shared) {
    const part = (name) => byId(name + "-" + number);
    const world = part("world"), chart = part("timeline"), pick = part("pick");
    const pane = { world, chart, pick, record: null, show, seek, draw };
    let record = null, frame = 0, position = 0; // position counts frames; its whole part is the frame

    function show(next) {
      record = pane.record = next;
      part("pane").hidden = !next;
      if (!next) return;
      part("sum").textContent = next.summary;
      world.setAttribute("aria-label", next.label + ". " + next.summary);
      for (const row of part("pane").querySelectorAll(".of-intrinsic")) row.hidden = !next.intrinsic;
    }

    function seek(step) {
      position = step >= record.steps ? record.last : Math.max(0, step / record.stride);
      frame = Math.floor(position + 1e-9);
      world.dataset.frame = String(frame); world.dataset.view = byId("view").value;
      const text = (name, value, digits, unit) => { const place = part(name); if (place) place.textContent = Number.isFinite(value) ? value.toFixed(digits) + (unit || "") : "–"; };
      const { total } = record;
      text("now-return", total.reward[frame], 2); text("now-reward", record.reward[frame], 3);
      text("now-cost", total.cost[frame], 3); text("now-step-cost", record.cost[frame], 3);
      text("now-hits", total.hits[frame], 0); text("now-goals", record.goals[frame], 0);
      text("now-outside", record.outside[frame], 1, " m"); text("now-away", (100 * record.timeOutside[frame]) / Math.max(1, frame), 0, " %");
      if (record.intrinsic) { text("now-intrinsic", total.intrinsic[frame], 2); text("now-step-intrinsic", record.intrinsic[frame], 4); }
      part("now-cost").classList.toggle("hit", total.cost[frame] > 0);
      part("now-step-cost").classList.toggle("hit", record.cost[frame] > 0);
    }

    function draw() { drawWorld(); drawChart(); }

    function rgb(name) {
      const hex = shared.palette[name] || shared.palette.ink;
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
      if (!p || body === record.goal || frame >= record.last || share <= 0) return p;
      const q = record.pose(body, frame + 1);
      if (!q) return p;
      const sign = p[3] * q[3] + p[4] * q[4] + p[5] * q[5] + p[6] * q[6] < 0 ? -1 : 1;
      const mixed = p.map((value, i) => value + share * ((i < 3 ? q[i] : sign * q[i]) - value));
      const norm = Math.hypot(...mixed.slice(3)) || 1;
      return mixed.map((value, i) => (i < 3 ? value : value / norm));
    }

    function things() { // solids by thing: a list of { look, solids, p }
      const poses = new Map(), out = new Map();
      for (const shape of record.shapes) {
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

    function camera(width, height) { // with .span: metres that are seen across its middle
      const kind = byId("view").value, { all, reach } = record;
      if (kind === "top") {
        const half = all.half / shared.zoom;
        return { ...view3d.topCamera(all.x, all.y, half, width, height), target: [all.x, all.y], span: 2 * half };
      }
      const make = (x, y, z, distance) => ({ ...view3d.orbitCamera([x, y, z], shared.azimuth, shared.elevation, distance, width, height), target: [x, y], span: distance / 2 });
      if (kind === "follow") {
        const [x, y] = smooth(record.path), box = record.boxPath && smooth(record.boxPath), distance = 2.9 + 4 * reach;
        if (!box) return make(x, y, 0.1, distance / shared.zoom);
        const apart = Math.hypot(box[0] - x, box[1] - y), share = 0.5 * Math.min(1, Math.max(0, 2.2 - apart)); // a box nearby is kept in view
        return make(x + share * (box[0] - x), y + share * (box[1] - y), 0.1, (distance + 2.4 * share * apart) / shared.zoom);
      }
      let distance = 1; // far enough to hold the four corners
      const corners = [all.low, all.high].flatMap(([x]) => [all.low, all.high].map(([, y]) => [x, y, 0]));
      const holds = (eye) => corners.every((corner) => { const p = eye.project(corner); return p && p[0] > 14 && p[0] < width - 14 && p[1] > 14 && p[1] < height - 14; });
      while (distance < 2000 && !holds(make(all.x, all.y, 0, distance))) distance *= 1.03;
      return make(all.x, all.y, 0, distance / shared.zoom);
    }

    function smooth(path) { // a place averaged over about a second, so that the camera glides
      const wide = Math.max(1, Math.round(0.6 / record.frameTime)), share = position - frame;
      let x = 0, y = 0, weight = 0;
      for (let i = frame - wide; i <= frame + wide + 1; i++) {
        const p = path[Math.min(record.last, Math.max(0, i))];
        if (!p) continue;
        const w = Math.max(0, 1 - Math.abs(i - frame - share) / (wide + 1));
        x += w * p[0]; y += w * p[1]; weight += w;
      }
      return weight ? [x / weight, y / weight] : [record.all.x, record.all.y];
    }

    // ---- drawing

    function drawWorld() {
      const { pen, width, height } = prepare(world), { palette } = shared;
      if (!width || !height) return;
      const eye = camera(width, height);
      drawFloor(pen, eye, width, height);
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
      const robot = poseNow(record.robot);
      if (robot && flash > 0) view3d.polygon(pen, eye, view3d.circle(robot[0], robot[1], 0.002, record.reach + 0.06), { fill: palette.limit, alpha: 0.45 * flash });
      if (robot && byId("show-lidar").checked) drawLidars(pen, eye, robot);
      drawSolids(pen, eye, solid, goal, robot);
      if (robot) drawLocator(pen, eye, robot);
      if (byId("view").value === "follow") drawMap(pen, all, robot, width, height);
      drawNotice(pen, height);
      if (flash > 0) {
        pen.globalAlpha = flash; pen.strokeStyle = palette.limit; pen.lineWidth = 8;
        pen.strokeRect(4, 4, width - 8, height - 8); pen.globalAlpha = 1;
      }
    }

    function violationNow() { // 1 in a violation, fading over a third of a second after it
      const hold = Math.max(1, Math.round(0.35 / record.frameTime));
      for (let age = 0; age < hold && frame - age >= 0; age++) if (record.violations[frame - age] > 0) return 1 - age / hold;
      return 0;
    }

    function square(a, b, c, d) { return [[a, b, 0], [c, b, 0], [c, d, 0], [a, d, 0]]; }

    // A floor without end: tiles around the place that is looked at, which fade far away.
    function drawFloor(pen, eye, width, height) {
      const { palette } = shared, horizon = Math.max(0, Math.min(height, eye.horizon));
      pen.fillStyle = palette.page; pen.fillRect(0, 0, width, height);
      pen.fillStyle = palette.floor; pen.fillRect(0, horizon, width, height - horizon);
      const size = 0.5 * 2 ** Math.max(0, Math.ceil(Math.log2(eye.span / 14))), reach = 26, shades = 4;
      const ci = Math.round(eye.target[0] / size), cj = Math.round(eye.target[1] / size);
      const tiles = Array.from({ length: shades }, () => []);
      for (let i = ci - reach; i < ci + reach; i++) for (let j = cj - reach; j < cj + reach; j++) {
        const far = Math.hypot((i + 0.5) * size - eye.target[0], (j + 0.5) * size - eye.target[1]) / (reach * size);
        if ((i + j) & 1 && far < 1) tiles[Math.min(shades - 1, Math.floor(Math.max(0, far - 0.4) * (shades / 0.6)))].push(square(i * size, j * size, (i + 1) * size, (j + 1) * size));
      }
      tiles.forEach((squares, k) => view3d.fillAll(pen, eye, squares, palette.tile, 1 - k / shades));
      const [a, b, c, d] = record.extents;
      view3d.polygon(pen, eye, square(a, b, c, d), { fill: palette.card, alpha: 0.42, stroke: palette.ink, width: 2.5, line: 0.75 });
    }

    function drawGoalBase(pen, eye, goal) {
      const { palette } = shared, [x, y] = goal.p, r = goal.solids[0].size[0];
      view3d.polygon(pen, eye, view3d.circle(x, y, 0.001, r), { fill: palette.goal, alpha: 0.38, stroke: palette.goal, width: 1.5 });
      const met = record.moves.filter((t) => t <= frame).pop(); // a ring spreads where a goal was met
      const age = met === undefined ? 1 : ((position - met) * record.frameTime) / 0.7;
      const old = age < 1 && record.pose(record.goal, met - 1);
      if (old) view3d.polygon(pen, eye, view3d.circle(old[0], old[1], 0.001, r * (1 + age)), { stroke: palette.goal, width: 3, line: 1 - age });
    }

    function drawTrail(pen, eye) {
      const { palette } = shared, seen = (t) => record.path[t] && eye.project([record.path[t][0], record.path[t][1], 0.003]);
      let from = seen(0), run = null;
      for (let t = 1; t <= frame; t++) {
        const to = seen(t), hit = record.violations[t] > 0, alpha = hit ? 0.95 : Math.max(0.16, 0.7 - Math.floor((frame - t) * record.frameTime) / 12);
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
      const { palette } = shared, columns = axes(robot.slice(3)), width = 0.075, z = 0.004;
      const along = (angle, r) => { // a direction of the robot's frame, laid on the floor
        const v = turn(columns, [Math.cos(angle), Math.sin(angle), 0]), n = Math.hypot(v[0], v[1]) || 1;
        return [robot[0] + (r * v[0]) / n, robot[1] + (r * v[1]) / n, z];
      };
      record.lidars.forEach((lidar, k) => {
        const inner = record.reach + 0.07 + k * (width + 0.02), step = (2 * Math.PI) / lidar.bins;
        for (let bin = 0; bin < lidar.bins; bin++) {
          const reading = lidar.values[frame * lidar.bins + bin] / 255, parts = 32 / lidar.bins + 1;
          const at = (i) => (bin + 0.05 + (0.9 * i) / parts) * step, edge = (r) => Array.from({ length: parts + 1 }, (_, i) => along(at(i), r));
          const points = edge(inner).concat(edge(inner + width).reverse());
          view3d.polygon(pen, eye, points, { fill: palette[lidar.name], alpha: reading ? 0.12 + 0.88 * Math.sqrt(reading) : 0, stroke: palette.muted, width: 0.7, line: 0.45 });
        }
      });
      const tip = record.reach + 0.05 + record.lidars.length * (width + 0.02) + 0.02; // a mark says where it is headed
      view3d.polygon(pen, eye, [along(record.heading, tip + 0.09), along(record.heading - 0.13, tip), along(record.heading + 0.13, tip)], { fill: palette.ink, alpha: 0.75 });
    }

    // Things stand side by side: circles on the floor, of which the one whose tangent
    // from the eye is longer is behind. A see-through goal has a far and a near half.
    function drawSolids(pen, eye, solid, goal, robot) {
      const far = (x, y, r) => (x - eye.eye[0]) ** 2 + (y - eye.eye[1]) ** 2 - r * r;
      const jobs = solid.map((thing) => {
        const [x, y] = thing.p, r = thing.look === "robot" || thing.look === "trim" ? record.reach : footprint(thing.solids[0]);
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

    function hides(eye, thing, robot) { // whether a pillar or a box stands between the eye and the robot
      if (eye.flat || !robot || (thing.look !== "pillars" && thing.look !== "box")) return false;
      const [x, y] = [robot[0] - eye.eye[0], robot[1] - eye.eye[1]], [u, v] = [thing.p[0] - eye.eye[0], thing.p[1] - eye.eye[1]];
      const norm = Math.hypot(x, y), share = (u * x + v * y) / norm ** 2;
      return share > 0 && share < 1 && Math.abs(u * y - v * x) / norm < footprint(thing.solids[0]) + 0.1;
    }

    function footprint(s) {
      if (s.kind === "prism") return Math.max(...s.outline.map((c) => Math.hypot(c[0], c[1]))) * 0.8;
      return s.kind === "box" ? s.size[0] * 1.2 : s.size[0];
    }

    function drawGoalWall(pen, eye, goal, near) {
      const { palette } = shared, s = goal.solids[0], [x, y, z] = s.c, low = view3d.circle(x, y, z - s.size[1], s.size[0]), high = view3d.circle(x, y, z + s.size[1], s.size[0]);
      low.forEach((p, i) => {
        const j = (i + 1) % low.length, normal = [p[0] - x, p[1] - y, 0];
        if (eye.flat || view3d.faces(eye, p, normal) !== near) return;
        view3d.polygon(pen, eye, [p, low[j], high[j], high[i]], { fill: palette.goal, alpha: near ? 0.3 : 0.22 });
        view3d.polygon(pen, eye, [high[i], high[j]], { stroke: palette.goal, width: 1.5 });
      });
    }

    function drawLocator(pen, eye, robot) { // a ring around a robot that is too small to be seen
      const p = eye.project(robot);
      if (!p || eye.radius(record.reach, p[2]) > 7) return;
      pen.strokeStyle = shared.palette.robot; pen.lineWidth = 2;
      pen.beginPath(); pen.arc(p[0], p[1], 10, 0, 2 * Math.PI); pen.stroke();
    }

    function drawMap(pen, all, robot, width, height) { // a small map in a corner: where in the arena this is
      const { palette } = shared, side = Math.max(84, Math.min(150, 0.3 * Math.min(width, height))), left = width - side - 12, top = 12;
      const seen = record.seen[frame], scale = side / (2 * seen.half), to = ([x, y]) => [left + side / 2 + (x - seen.x) * scale, top + side / 2 - (y - seen.y) * scale];
      const dot = (p, r, fill, alpha) => { const [x, y] = to(p); pen.globalAlpha = alpha; pen.fillStyle = fill; pen.beginPath(); pen.arc(x, y, Math.max(1.5, r * scale), 0, 2 * Math.PI); pen.fill(); pen.globalAlpha = 1; };
      pen.save();
      pen.globalAlpha = 0.9; pen.fillStyle = palette.card; pen.fillRect(left, top, side, side); pen.globalAlpha = 1;
      pen.strokeStyle = palette.muted; pen.lineWidth = 1; pen.strokeRect(left, top, side, side);
      pen.beginPath(); pen.rect(left, top, side, side); pen.clip();
      const [a, b, c, d] = record.extents, [x0, y1] = to([a, b]), [x1, y0] = to([c, d]);
      pen.fillStyle = palette.tile; pen.fillRect(x0, y0, x1 - x0, y1 - y0);
      pen.strokeStyle = palette.ink; pen.lineWidth = 1.5; pen.strokeRect(x0, y0, x1 - x0, y1 - y0);
      for (const thing of all) if (thing.look !== "robot" && thing.look !== "trim") dot(thing.p, footprint(thing.solids[0]), palette[thing.look], 0.8);
      pen.beginPath(); pen.strokeStyle = palette.muted; pen.lineWidth = 1;
      for (let t = 0; t <= frame; t++) if (record.path[t]) pen.lineTo(...to(record.path[t]));
      pen.stroke();
      if (robot) dot(robot, 3.5 / scale, palette.robot, 1);
      pen.restore();
    }

    function drawNotice(pen, height) { // says so when the robot has left the arena
      const away = record.outside[frame];
      if (!(away > 0.05)) return;
      const text = "outside the arena, " + away.toFixed(1) + " m from its border";
      pen.font = "600 13px " + shared.palette.sans;
      const wide = pen.measureText(text).width;
      pen.globalAlpha = 0.9; pen.fillStyle = shared.palette.card; pen.fillRect(12, height - 38, wide + 18, 26); pen.globalAlpha = 1;
      pen.fillStyle = shared.palette.limit; pen.fillText(text, 21, height - 20);
    }

    // ---- the chart

    function drawChart() {
      const { palette, scale } = shared, { pen, width, height } = prepare(chart), end = (scale.steps * scale.step) / record.dt;
      const at = (t) => 2 + (Math.min(record.steps, t * record.stride) / end) * (width - 4), bar = Math.max(1.2, ((record.stride * width) / end) * 0.9);
      pen.fillStyle = palette.page; pen.fillRect(0, 0, width, height);
      pen.fillStyle = palette.limit; pen.globalAlpha = 0.45;
      for (let t = 1; t <= record.last; t++) if (record.cost[t] > 0) pen.fillRect(at(t) - 0.5, height, bar, -(height - 18) * (0.1 + (0.3 * record.cost[t]) / scale.now));
      pen.globalAlpha = 1;
      if (record.intrinsic) line(record.intrinsic.map((v, t) => (t ? v : NaN)), palette.third, 1, 0, scale.intrinsic); // frame 0 has no step
      line(record.total.cost, palette.limit, 1.6, 0, scale.cost);
      line(record.total.reward, palette.best, 2, ...scale.reward);
      pen.fillStyle = palette.goal;
      for (const t of record.moves) { pen.beginPath(); pen.arc(at(t), 7, 3.2, 0, 2 * Math.PI); pen.fill(); }
      pen.fillStyle = palette.ink; pen.fillRect(Math.min(at(frame) - 0.75, width - 2), 0, 1.5, height);

      function line(values, colour, thick, low, high) {
        const y = (v) => height - 4 - ((v - low) / (high - low)) * (height - 20);
        pen.strokeStyle = colour; pen.lineWidth = thick; pen.beginPath();
        let down = false;
        values.forEach((v, t) => {
          if (Number.isFinite(v)) { if (down) pen.lineTo(at(t), y(v)); else pen.moveTo(at(t), y(v)); }
          down = Number.isFinite(v);
        });
        pen.stroke();
      }
    }

    return pane;
  }
})();
