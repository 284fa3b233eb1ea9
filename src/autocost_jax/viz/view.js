"use strict";
// Solids on a 2-D canvas: cameras, shading, and what hides what. No library, no WebGL.
const view3d = (function () {
  const LIGHT = unit([-0.45, -0.35, 0.82]); // points towards the light
  const NEAR = 0.15; // metres in front of the eye from which on things are drawn
  let veil = 1; // opacity of the thing that is being drawn

  function add(a, b, k) { return [a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2]]; }
  function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
  function cross(a, b) { return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]; }
  function unit(a) { const n = Math.hypot(a[0], a[1], a[2]) || 1; return [a[0] / n, a[1] / n, a[2] / n]; }

  function axes([w, x, y, z]) { // of a rotation: the three columns of its matrix
    return [
      [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ];
  }
  function turn(columns, v) { return add(add(add([0, 0, 0], columns[0], v[0]), columns[1], v[1]), columns[2], v[2]); }

  // ---- cameras: each projects a point to [x, y, depth], or null if it is behind the eye

  function topCamera(x, y, half, width, height) {
    const scale = Math.min(width, height) / (2 * half);
    return {
      flat: true, horizon: 0, eye: [x, y, 50], towards: [0, 0, -1], right: [1, 0, 0], up: [0, 1, 0],
      project: (p) => [width / 2 + (p[0] - x) * scale, height / 2 - (p[1] - y) * scale, 50 - p[2]],
      radius: (r) => r * scale,
    };
  }

  function orbitCamera(target, azimuth, elevation, distance, width, height) {
    const c = Math.cos(elevation), towards = [-c * Math.cos(azimuth), -c * Math.sin(azimuth), -Math.sin(elevation)];
    const eye = add(target, towards, -distance), right = unit(cross(towards, [0, 0, 1])), up = cross(right, towards);
    const focal = 2 * Math.min(width, 1.25 * height);
    const depthOf = (p) => dot(add(p, eye, -1), towards);
    return {
      flat: false, eye, towards, right, up, depthOf,
      horizon: height / 2 - focal * Math.tan(elevation), // its line on the canvas
      project(p) {
        const v = add(p, eye, -1), depth = dot(v, towards);
        return depth < NEAR ? null : [width / 2 + (focal * dot(v, right)) / depth, height / 2 - (focal * dot(v, up)) / depth, depth];
      },
      radius: (r, depth) => (focal * r) / Math.sqrt(Math.max(depth * depth - r * r, NEAR * NEAR)),
    };
  }

  function faces(camera, point, normal) { // whether a face is turned towards the eye
    return camera.flat ? normal[2] > 1e-9 : dot(normal, add(camera.eye, point, -1)) > 0;
  }

  // ---- colours

  function tone([r, g, b], k) { // darker below 1, towards white above
    const mix = (c) => Math.round(k <= 1 ? c * k : c + (255 - c) * Math.min(k - 1, 1));
    return "rgb(" + mix(r) + "," + mix(g) + "," + mix(b) + ")";
  }
  function lit(normal) { return 0.62 + 0.34 * Math.max(0, dot(normal, LIGHT)) + 0.1 * normal[2]; }

  // ---- flat things

  function clip(camera, points) { // the part of a polygon that is in front of the eye
    if (camera.flat) return points;
    const depth = points.map(camera.depthOf), near = NEAR * 1.001;
    if (depth.every((d) => d >= near)) return points;
    return points.flatMap((p, i) => {
      const j = (i + 1) % points.length, out = depth[i] >= near ? [p] : [];
      if ((depth[i] < near) !== (depth[j] < near)) out.push(add(p, add(points[j], p, -1), (near - depth[i]) / (depth[j] - depth[i])));
      return out;
    });
  }

  function trace(pen, camera, points) { // a closed path; false if nothing of it is in front of the eye
    const seen = clip(camera, points).map(camera.project);
    if (!seen.length || seen.includes(null)) return false;
    pen.moveTo(seen[0][0], seen[0][1]);
    for (let i = 1; i < seen.length; i++) pen.lineTo(seen[i][0], seen[i][1]);
    pen.closePath();
    return true;
  }

  function polygon(pen, camera, points, style) { // style: fill, stroke, width, alpha, line
    pen.beginPath();
    if (!trace(pen, camera, points)) return;
    pen.globalAlpha = veil * (style.alpha === undefined ? 1 : style.alpha);
    if (style.fill) { pen.fillStyle = style.fill; pen.fill(); }
    if (style.stroke && veil === 1) { pen.globalAlpha = style.line === undefined ? 1 : style.line; pen.strokeStyle = style.stroke; pen.lineWidth = style.width || 1; pen.stroke(); }
    pen.globalAlpha = 1;
  }

  function fillAll(pen, camera, polygons, fill, alpha) { // many at once, in one colour
    pen.beginPath();
    for (const points of polygons) trace(pen, camera, points);
    pen.globalAlpha = alpha; pen.fillStyle = fill; pen.fill(); pen.globalAlpha = 1;
  }

  function circle(x, y, z, r, corners) {
    return Array.from({ length: corners || 48 }, (_, i) => {
      const a = (2 * Math.PI * i) / (corners || 48);
      return [x + r * Math.cos(a), y + r * Math.sin(a), z];
    });
  }

  // ---- solids: { kind, size, c (centre), a (axes), rgb, look }

  function ring(s, z) { // corners of a cylinder's end
    const count = s.size[0] > 0.15 ? 44 : 26;
    return Array.from({ length: count }, (_, i) => {
      const t = (2 * Math.PI * i) / count;
      return add(add(add(s.c, s.a[0], s.size[0] * Math.cos(t)), s.a[1], s.size[0] * Math.sin(t)), s.a[2], z);
    });
  }

  function prismEnd(s, z) { return s.outline.map(([x, y]) => add(add(add(s.c, s.a[0], x), s.a[1], y), s.a[2], z)); }

  function corners(s) {
    const [x, y, z] = s.size, out = [];
    for (const i of [-x, x]) for (const j of [-y, y]) for (const k of [-z, z]) out.push(add(add(add(s.c, s.a[0], i), s.a[1], j), s.a[2], k));
    return out;
  }

  function drawBox(pen, camera, s) {
    for (let i = 0; i < 3; i++) for (const sign of [-1, 1]) {
      const normal = add([0, 0, 0], s.a[i], sign), centre = add(s.c, normal, s.size[i]);
      if (!faces(camera, centre, normal)) continue;
      const u = s.a[(i + 1) % 3], v = s.a[(i + 2) % 3], hu = s.size[(i + 1) % 3], hv = s.size[(i + 2) % 3];
      const points = [[1, 1], [1, -1], [-1, -1], [-1, 1]].map(([p, q]) => add(add(centre, u, p * hu), v, q * hv));
      const colour = tone(s.rgb, lit(normal));
      polygon(pen, camera, points, { fill: colour, stroke: colour, width: 0.7 });
    }
  }

  function drawMantle(pen, camera, s, low, high) { // the sides between two equal ends, far ones first
    const sides = low.map((p, i) => {
      const j = (i + 1) % low.length, edge = add(low[j], p, -1), normal = unit(cross(edge, s.a[2]));
      return { points: [p, low[j], high[j], high[i]], normal };
    }).filter((side) => faces(camera, side.points[0], side.normal));
    const depth = (side) => dot(add(add(side.points[0], side.points[2], 1), camera.eye, -2), camera.towards);
    sides.sort((p, q) => depth(q) - depth(p));
    for (const side of sides) {
      const colour = tone(s.rgb, lit(side.normal));
      polygon(pen, camera, side.points, { fill: colour, stroke: colour, width: 0.7 });
    }
  }

  function drawEnds(pen, camera, s, low, high, h) {
    for (const [points, sign] of [[low, -1], [high, 1]]) {
      const normal = add([0, 0, 0], s.a[2], sign), centre = add(s.c, normal, h);
      if (!faces(camera, centre, normal)) continue;
      const colour = tone(s.rgb, lit(normal) + 0.06);
      polygon(pen, camera, points, { fill: colour, stroke: colour, width: 0.7 });
      if (s.look === "wheel") { // a cross of spokes: one sees it roll
        for (const axis of [s.a[0], s.a[1]]) {
          polygon(pen, camera, [add(centre, axis, 0.75 * s.size[0]), add(centre, axis, -0.75 * s.size[0])], { stroke: tone(s.rgb, 1.5), width: 1.6 });
        }
      }
    }
  }

  function drawSphere(pen, camera, s) {
    const p = camera.project(s.c);
    if (!p) return;
    const r = camera.radius(s.size[0], p[2]);
    pen.beginPath(); pen.arc(p[0], p[1], r, 0, 2 * Math.PI);
    pen.fillStyle = ball(pen, camera, p[0], p[1], r, s.rgb); pen.fill();
  }

  function ball(pen, camera, x, y, r, rgb) {
    const gx = x + 0.45 * r * dot(LIGHT, camera.right), gy = y - 0.45 * r * dot(LIGHT, camera.up);
    const shade = pen.createRadialGradient(gx, gy, 0.05 * r, x, y, 1.02 * r);
    shade.addColorStop(0, tone(rgb, 1.32)); shade.addColorStop(0.45, tone(rgb, 1)); shade.addColorStop(1, tone(rgb, 0.58));
    return shade;
  }

  function drawCapsule(pen, camera, s) {
    const p = camera.project(add(s.c, s.a[2], -s.size[1])), q = camera.project(add(s.c, s.a[2], s.size[1]));
    if (!p || !q) return;
    const rp = camera.radius(s.size[0], p[2]), rq = camera.radius(s.size[0], q[2]);
    const dx = q[0] - p[0], dy = q[1] - p[1], d = Math.hypot(dx, dy);
    pen.beginPath();
    if (d <= Math.abs(rp - rq) + 1e-6) { // seen from its end
      const near = p[2] < q[2] ? p : q, r = Math.max(rp, rq);
      pen.arc(near[0], near[1], r, 0, 2 * Math.PI); pen.fillStyle = ball(pen, camera, near[0], near[1], r, s.rgb); pen.fill();
      return;
    }
    const along = Math.atan2(dy, dx), open = Math.acos((rp - rq) / d);
    pen.arc(p[0], p[1], rp, along + open, along - open); pen.arc(q[0], q[1], rq, along - open, along + open); pen.closePath();
    const nx = -dy / d, ny = dx / d, r = Math.max(rp, rq), x = (p[0] + q[0]) / 2, y = (p[1] + q[1]) / 2;
    const side = nx * dot(LIGHT, camera.right) - ny * dot(LIGHT, camera.up) > 0 ? 1 : -1;
    const shade = pen.createLinearGradient(x + side * nx * r, y + side * ny * r, x - side * nx * r, y - side * ny * r);
    shade.addColorStop(0, tone(s.rgb, 1.04)); shade.addColorStop(0.3, tone(s.rgb, 1.22)); shade.addColorStop(0.6, tone(s.rgb, 0.95)); shade.addColorStop(1, tone(s.rgb, 0.55));
    pen.fillStyle = shade; pen.fill();
  }

  function drawSolid(pen, camera, s) {
    if (s.kind === "sphere") return drawSphere(pen, camera, s);
    if (s.kind === "capsule") return drawCapsule(pen, camera, s);
    if (s.kind === "box") return drawBox(pen, camera, s);
    const h = s.kind === "prism" ? s.size[0] : s.size[1];
    const [low, high] = s.kind === "prism" ? [prismEnd(s, -h), prismEnd(s, h)] : [ring(s, -h), ring(s, h)];
    drawMantle(pen, camera, s, low, high);
    drawEnds(pen, camera, s, low, high, h);
  }

  // ---- what hides what

  function extent(s, n) { // half the width of a solid in direction n
    const along = (i) => Math.abs(dot(s.a[i], n));
    if (s.kind === "sphere") return s.size[0];
    if (s.kind === "capsule") return s.size[0] + s.size[1] * along(2);
    if (s.kind === "box") return s.size[0] * along(0) + s.size[1] * along(1) + s.size[2] * along(2);
    const h = s.kind === "prism" ? s.size[0] : s.size[1];
    const r = s.kind === "prism" ? Math.max(...s.outline.map((c) => Math.hypot(c[0], c[1]))) : s.size[0];
    return h * along(2) + r * Math.sqrt(Math.max(0, 1 - along(2) ** 2));
  }

  function planes(s) { // faces that can separate a solid from its neighbours
    if (s.kind !== "box" && s.kind !== "cylinder") return [];
    const list = s.kind === "box" ? [[0, s.size[0]], [1, s.size[1]], [2, s.size[2]]] : [[2, s.size[1]]];
    return list.flatMap(([i, h]) => [-1, 1].map((sign) => {
      const n = add([0, 0, 0], s.a[i], sign);
      return { n, d: dot(n, s.c) + h };
    }));
  }

  function beforeEye(camera, plane) { return camera.flat ? plane.n[2] > 0 : dot(plane.n, camera.eye) > plane.d; }

  function isInFront(camera, s, t) { // s is drawn after t: true, false, or null for either
    for (const plane of t.planes) if (dot(plane.n, s.c) - extent(s, plane.n) >= plane.d - 2e-3) return beforeEye(camera, plane);
    for (const plane of s.planes) if (dot(plane.n, t.c) - extent(t, plane.n) >= plane.d - 2e-3) return !beforeEye(camera, plane);
    return null;
  }

  function order(camera, solids) { // the parts of one thing, far ones first
    const depth = (s) => dot(add(s.c, camera.eye, -1), camera.towards);
    const left = solids.slice().sort((s, t) => depth(t) - depth(s)), done = [];
    for (const s of left) s.planes = planes(s);
    while (left.length) {
      let pick = left.findIndex((s) => left.every((t) => s === t || isInFront(camera, s, t) !== true));
      done.push(...left.splice(Math.max(0, pick), 1));
    }
    return done;
  }

  function drawThing(pen, camera, solids, opacity) {
    veil = opacity;
    for (const s of order(camera, solids)) drawSolid(pen, camera, s);
    veil = 1;
  }

  // ---- shadows on the floor

  function outlineOf(s) { // points whose hull is the solid's shadow
    if (s.kind === "box") return corners(s);
    if (s.kind === "prism") return prismEnd(s, -s.size[0]).concat(prismEnd(s, s.size[0]));
    if (s.kind === "cylinder") return ring(s, -s.size[1]).concat(ring(s, s.size[1]));
    const ends = s.kind === "sphere" ? [s.c] : [add(s.c, s.a[2], -s.size[1]), add(s.c, s.a[2], s.size[1])];
    const u = unit(cross(LIGHT, [0, 1, 0])), v = cross(LIGHT, u);
    return ends.flatMap((c) => Array.from({ length: 14 }, (_, i) => {
      const t = (2 * Math.PI * i) / 14;
      return add(add(c, u, s.size[0] * Math.cos(t)), v, s.size[0] * Math.sin(t));
    }));
  }

  function hull(points) { // convex, counter-clockwise
    points.sort((p, q) => p[0] - q[0] || p[1] - q[1]);
    const half = (list) => {
      const out = [];
      for (const p of list) {
        while (out.length > 1) {
          const [a, b] = out.slice(-2);
          if ((b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0]) > 0) break;
          out.pop();
        }
        out.push(p);
      }
      return out.slice(0, -1);
    };
    return half(points).concat(half(points.reverse()));
  }

  function drawShadows(pen, camera, solids, alpha) {
    pen.beginPath();
    for (const s of solids) {
      const fallen = outlineOf(s).map((p) => { const z = Math.max(p[2], 0); return [p[0] - (LIGHT[0] / LIGHT[2]) * z, p[1] - (LIGHT[1] / LIGHT[2]) * z, 0]; });
      trace(pen, camera, hull(fallen));
    }
    pen.globalAlpha = alpha; pen.fillStyle = "#000"; pen.fill(); pen.globalAlpha = 1;
  }

  return { add, dot, unit, axes, turn, topCamera, orbitCamera, polygon, fillAll, circle, drawThing, drawShadows, faces };
})();
