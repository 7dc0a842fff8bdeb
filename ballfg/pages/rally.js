// Draws a rally: the video with the reprojected flight, the table in space, strokes and bounces, on one time line.
"use strict";

const page = JSON.parse(document.getElementById("data").textContent);
const element = id => document.getElementById(id);
const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const HIT_FROM = {"+x": "#d55e00", "-x": "#0072b2"};
const BALL = "#f5a623", REGION = Math.sqrt(4.605);  // radius of the 90 % region of two dimensions, standard deviations
const video = element("video"), times = page.frames.map(frame => frame[0]);
const first = times[0], last = times[times.length - 1], step = (last - first) / Math.max(times.length - 1, 1);
const table = page.table, [x0, x1, y0, y1] = table.extent, h = table.height;
let now = first, playing = false, chosen = -1, turn = {azimuth: -1.1, height: 0.45, away: 5.4}, since = null;
let hasVideo = Boolean(video.getAttribute("src"));

// A camera is [t, focal, rotation by rows, translation, k1], as in camera_motion.csv.
function seen(camera, p) {
  const r = camera.slice(2, 11), t = camera.slice(11, 14);
  const [x, y, z] = [0, 1, 2].map(i => r[3 * i] * p[0] + r[3 * i + 1] * p[1] + r[3 * i + 2] * p[2] + t[i]);
  if (z <= 0.05) return null;
  const u = x / z, v = y / z, bent = camera[1] * (1 + camera[14] * (u * u + v * v));
  return [bent * u + (page.size[0] - 1) / 2, bent * v + (page.size[1] - 1) / 2];
}

const frameAt = t => {
  let low = 0, high = times.length - 1;
  while (low < high) { const middle = (low + high + 1) >> 1; if (times[middle] <= t + 0.25 * step) low = middle; else high = middle - 1; }
  return low;
};
const inFrame = t => Math.abs(times[frameAt(t)] - t) < 1.5 * step;
const strokeAt = t => page.strokes.findIndex((s, i) => t >= s.t_start && t < (page.strokes[i + 1]?.t_start ?? s.t_end + step) &&
                                                       t <= s.path[s.path.length - 1][0] + step);
const tint = stroke => HIT_FROM[stroke.end] ?? BALL;

function placeAt(stroke, t) {
  const path = stroke.path;
  let i = path.findIndex(p => p[0] > t);
  if (i < 0) i = path.length - 1;
  const a = path[Math.max(i - 1, 0)], b = path[i], s = b[0] > a[0] ? Math.min(Math.max((t - a[0]) / (b[0] - a[0]), 0), 1) : 0;
  return [1, 2, 3].map(k => a[k] + s * (b[k] - a[k]));
}

// The 90 % region of a place as project sees it: the ellipse of its covariance under the projection's derivative.
function region(project, place, c) {
  const middle = project(place);
  if (middle === null) return null;
  const E = 0.01, slope = [0, 1, 2].map(k => { const p = place.slice(); p[k] += E; const q = project(p); return q && q.map((v, i) => (v - middle[i]) / E); });
  if (slope.includes(null)) return null;
  const full = [[c[0], c[1], c[2]], [c[1], c[3], c[4]], [c[2], c[4], c[5]]];
  const s = (i, j) => full.reduce((sum, row, a) => sum + row.reduce((part, v, b) => part + slope[a][i] * v * slope[b][j], 0), 0);
  const xx = s(0, 0), xy = s(0, 1), yy = s(1, 1), half = (xx + yy) / 2, root = Math.hypot((xx - yy) / 2, xy);
  return {middle, large: REGION * Math.sqrt(half + root), small: REGION * Math.sqrt(Math.max(half - root, 0)), angle: 0.5 * Math.atan2(2 * xy, xx - yy)};
}

function nearest(stroke, t) {
  return stroke.samples.reduce((best, one) => Math.abs(one[0] - t) < Math.abs(best[0] - t) ? one : best).slice(1);
}

function sharp(canvas) {  // a canvas with a pixel for each of the screen's
  const scale = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  canvas.width = Math.round(box.width * scale); canvas.height = Math.round(box.height * scale);
  const pen = canvas.getContext("2d");
  pen.scale(scale, scale);
  return [pen, box.width, box.height];
}

function trace(pen, points, closed) {
  pen.beginPath();
  points.forEach(p => p === null ? null : pen.lineTo(p[0], p[1]));
  if (closed) pen.closePath();
  pen.stroke();
}

function ellipse(pen, where) {
  if (where === null) return;
  pen.beginPath();
  pen.ellipse(where.middle[0], where.middle[1], Math.max(where.large, 1), Math.max(where.small, 1), where.angle, 0, 2 * Math.PI);
  pen.stroke();
}

const along = (a, b) => Array.from({length: 13}, (_, i) => a.map((v, k) => v + (b[k] - v) * i / 12));
function outlines() {
  const found = table.lines.map(([a, b]) => along(a, b));
  if (table.net !== null) {
    const [net, reach] = table.net, low = [[0, -reach, h], [0, reach, h]], high = low.map(p => [p[0], p[1], h + net]);
    found.push(along(low[0], low[1]), along(low[0], high[0]), along(low[1], high[1]));
  }
  return found;
}

function flight(pen, project, stroke, bold) {
  pen.strokeStyle = tint(stroke);
  pen.lineWidth = bold ? 3 : 1;
  pen.globalAlpha = bold ? 1 : 0.35;
  trace(pen, stroke.path.map(p => project(p.slice(1))));
  pen.globalAlpha = 1;
}

function ballIn(pen, project, stroke) {
  const place = placeAt(stroke, now), at = project(place);
  if (at === null) return;
  pen.fillStyle = BALL; pen.beginPath(); pen.arc(at[0], at[1], 4, 0, 2 * Math.PI); pen.fill();
  if (element("doubt").checked) { pen.strokeStyle = BALL; pen.lineWidth = 1.5; ellipse(pen, region(project, place, nearest(stroke, now))); }
}

function drawOverlay() {
  element("screen").style.aspectRatio = `${page.size[0]} / ${page.size[1]}`;
  const [pen, width] = sharp(element("overlay")), index = frameAt(now), scale = width / page.size[0];
  if (!inFrame(now)) return;
  const camera = page.frames[index], project = p => { const q = seen(camera, p); return q && q.map(v => (v + 0.5) * scale); };
  if (element("court").checked) { pen.strokeStyle = "#39d98a"; pen.lineWidth = 1; outlines().forEach(line => trace(pen, line.map(project))); }
  const current = strokeAt(now);
  if (element("flights").checked && current >= 0) { flight(pen, project, page.strokes[current], true); ballIn(pen, project, page.strokes[current]); }
  if (element("spots").checked) {
    pen.lineWidth = 1;
    for (const [u, v, , flown] of page.candidates[index]) {
      pen.beginPath(); pen.arc((u + 0.5) * scale, (v + 0.5) * scale, flown ? 3 : 5, 0, 2 * Math.PI);
      pen.strokeStyle = pen.fillStyle = flown ? "#ffffff" : "#e6c229";
      if (flown) pen.fill(); else pen.stroke();
    }
  }
}

function drawSpace() {
  const [pen, width, height] = sharp(element("space")), ca = Math.cos(turn.azimuth), sa = Math.sin(turn.azimuth);
  const ch = Math.cos(turn.height), sh = Math.sin(turn.height), focal = 1.35 * Math.min(width, 1.7 * height);
  const project = p => {
    const q = [p[0] - (x0 + x1) / 2, p[1] - (y0 + y1) / 2, p[2] - h - 0.1];
    const ahead = -(ca * q[0] + sa * q[1]), right = -sa * q[0] + ca * q[1];
    const depth = turn.away + ch * ahead - sh * q[2], up = ch * q[2] + sh * ahead;
    return depth < 0.2 ? null : [width / 2 + focal * right / depth, height / 2 - focal * up / depth];
  };
  pen.strokeStyle = colour("--line"); pen.lineWidth = 1;
  if (table.floor !== null) for (const v of [-3, -2, -1, 0, 1, 2, 3]) {
    trace(pen, along([-3, v, table.floor], [3, v, table.floor]).map(project));
    trace(pen, along([v, -3, table.floor], [v, 3, table.floor]).map(project));
  }
  pen.fillStyle = "#2f7d6b55"; pen.beginPath();
  [[x0, y0, h], [x1, y0, h], [x1, y1, h], [x0, y1, h]].map(project).forEach(p => p && pen.lineTo(p[0], p[1]));
  pen.fill();
  pen.strokeStyle = "#2f7d6b"; pen.lineWidth = 1.5;
  outlines().forEach(line => trace(pen, line.map(project)));
  pen.fillStyle = colour("--ink"); pen.font = "12px system-ui, sans-serif"; pen.textAlign = "center";
  for (const [word, p] of [["−x end", [x0 - 0.3, 0, h]], ["+x end", [x1 + 0.3, 0, h]], [`${+(x1 - x0).toFixed(3)} m`, [(x0 + x1) / 2 + 0.6, y0 - 0.15, h]], [`${+(y1 - y0).toFixed(3)} m`, [x1 + 0.15, y0 + 0.35, h]]]) {
    const at = project(p);
    if (at) pen.fillText(word, at[0], at[1]);
  }
  const current = strokeAt(now), bold = current >= 0 ? current : chosen;
  page.strokes.forEach((stroke, i) => { if (i !== bold) flight(pen, project, stroke, false); });
  if (bold >= 0) flight(pen, project, page.strokes[bold], true);
  pen.fillStyle = colour("--ink");
  for (const event of page.events) {
    const at = event.kind === "bounce" && bold >= 0 && event.trajectory === page.strokes[bold].stroke ? project([event.x, event.y, event.z]) : null;
    if (at) { pen.beginPath(); pen.arc(at[0], at[1], 4, 0, 2 * Math.PI); pen.fill(); }
  }
  if (current >= 0) ballIn(pen, project, page.strokes[current]);
}

const SVG = "http://www.w3.org/2000/svg";
function add(parent, name, attributes, words) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (words !== undefined) made.textContent = words;
  parent.appendChild(made);
  return made;
}

function drawLine() {
  const line = element("line"), width = line.getBoundingClientRect().width || 800, at = t => 8 + (width - 16) * (t - first) / (last - first || 1);
  line.replaceChildren();
  line.setAttribute("viewBox", `0 0 ${width} 58`);
  page.strokes.forEach((stroke, i) => {
    const end = page.strokes[i + 1]?.t_start ?? stroke.t_end, left = at(stroke.t_start), wide = Math.max(at(Math.min(end, stroke.path[stroke.path.length - 1][0])) - left - 1, 2);
    add(line, "rect", {x: left, y: 8, width: wide, height: 22, fill: tint(stroke), opacity: 0.75, rx: 3});
    add(line, "text", {x: left + wide / 2, y: 24, "text-anchor": "middle", style: "fill:#fff"}, stroke.stroke);
  });
  for (const event of page.events) {
    if (event.kind === "bounce") add(line, "circle", {cx: at(event.t), cy: 34, r: 3, fill: colour("--ink")});
    if (event.kind === "cut") add(line, "line", {x1: at(event.t), x2: at(event.t), y1: 0, y2: 40, stroke: "#cc3311", "stroke-dasharray": "3 2"});
  }
  const every = [0.1, 0.2, 0.5, 1, 2, 5, 10, 30, 60].find(v => (last - first) / v < 15) ?? 120;
  for (let t = Math.ceil(first / every) * every; t <= last; t += every) add(line, "text", {x: at(t), y: 54, "text-anchor": "middle"}, `${+t.toFixed(2)} s`);
  add(line, "line", {id: "cursor", y1: 2, y2: 40, stroke: BALL, "stroke-width": 2});
  line.onpointerdown = event => { line.setPointerCapture(event.pointerId); line.onpointermove(event); };
  line.onpointermove = event => {
    if (event.buttons) seek(first + (last - first) * Math.min(Math.max((event.offsetX - 8) / (width - 16), 0), 1));
  };
  line.cursorAt = at;
}

function fillTable() {
  const body = element("strokes").tBodies[0];
  const pm = (value, sigma, scale, digits) => value === null || value === undefined ? "" : `${(scale * value).toFixed(digits)} ± ${(scale * (sigma ?? 0)).toFixed(digits)}`.replace(/-/g, "−");
  page.strokes.forEach((s, i) => {
    const row = body.insertRow(), top = s.end === "-x" ? 1 : -1;
    const cells = [s.stroke, s.t_start.toFixed(2), s.end.replace("-", "−"), pm(s.speed_hit, s.sigma_speed_hit, 1, 1), pm(s.speed_bounce, s.sigma_speed_bounce, 1, 1),
                   pm(s.spin_y === null ? null : top * s.spin_y, s.sigma_spin_y, 1, 0), pm(s.spin_z, s.sigma_spin_z, 1, 0), pm(s.net_clearance, s.sigma_net_clearance, 1000, 0),
                   pm(s.bounce_x, s.sigma_bounce_x, 1, 3), pm(s.bounce_y, s.sigma_bounce_y, 1, 3), s.status];
    cells.forEach(words => { row.insertCell().textContent = words; });
    row.tabIndex = 0;
    row.onclick = () => { chosen = i; seek(s.t_start); };
    row.onkeydown = event => { if (event.key === "Enter") row.onclick(); };
  });
}

function drawAbove() {
  const above = element("above"), edge = 0.45;
  above.setAttribute("viewBox", `0 0 800 ${(800 * (y1 - y0 + 2 * edge) / (x1 - x0 + 2 * edge)).toFixed(0)}`);
  const scale = 800 / (x1 - x0 + 2 * edge), at = (x, y) => [scale * (x - x0 + edge), scale * (y1 + edge - y)];
  const [left, top] = at(x0, y1), [middle, low] = at((x0 + x1) / 2, y0);
  add(above, "rect", {x: left, y: top, width: scale * (x1 - x0), height: scale * (y1 - y0), fill: "#2f7d6b33", stroke: "#2f7d6b", "stroke-width": 2});
  for (const [a, b] of table.lines) {
    const [from, to] = [at(a[0], a[1]), at(b[0], b[1])];
    if (a[2] === 0) add(above, "line", {x1: from[0], y1: from[1], x2: to[0], y2: to[1], stroke: "#2f7d6b"});
  }
  if (table.net !== null) add(above, "line", {x1: middle, x2: middle, y1: top - 20, y2: low + 20, stroke: "#888", "stroke-width": 2});
  for (const v of [-1, -0.5, 0, 0.5, 1]) add(above, "text", {x: at(v, 0)[0], y: low + 34, "text-anchor": "middle"}, `x ${v} m`.replace("-", "−"));
  for (const v of [-0.5, 0, 0.5]) add(above, "text", {x: left - 10, y: at(0, v)[1] + 4, "text-anchor": "end"}, `y ${v} m`.replace("-", "−"));
  for (const event of page.events.filter(one => one.kind === "bounce")) {
    const stroke = page.strokes.find(one => one.stroke === event.trajectory), [x, y] = at(event.x, event.y), fill = stroke ? tint(stroke) : BALL;
    add(above, "ellipse", {cx: x, cy: y, rx: REGION * scale * event.sigma_x, ry: REGION * scale * event.sigma_y, fill, opacity: 0.25});
    add(above, "circle", {cx: x, cy: y, r: 4, fill});
    add(above, "text", {x: x + 7, y: y - 6}, event.trajectory);
  }
}

function draw() {
  const current = strokeAt(now);
  drawOverlay();
  drawSpace();
  const cursor = element("cursor"), x = element("line").cursorAt(now);
  cursor.setAttribute("x1", x); cursor.setAttribute("x2", x);
  Array.from(element("strokes").tBodies[0].rows).forEach((row, i) => row.classList.toggle("now", i === current));
  const words = [`t = ${now.toFixed(3)} s`, `picture ${frameAt(now) + 1} of ${times.length}`];
  if (current >= 0) {
    const place = placeAt(page.strokes[current], now);
    words.push(`stroke ${page.strokes[current].stroke}`, ["x", "y", "z"].map((a, i) => `${a} ${place[i].toFixed(3)} m`).join(", "));
  }
  element("readout").textContent = words.join(" · ");
}

function seek(t, keep) {
  now = Math.min(Math.max(t, first), last);
  if (hasVideo && !keep) video.currentTime = now + 0.25 * step;
  draw();
}

function tick(stamp) {
  if (!playing) return;
  if (hasVideo && !video.paused) seek(video.currentTime - 0.25 * step, true);
  else { seek(now + (since === null ? 0 : Number(element("rate").value) * (stamp - since) / 1000), hasVideo); since = stamp; }
  if (now >= last) return play(false);
  requestAnimationFrame(tick);
}

function play(on) {
  playing = on; since = null;
  element("play").textContent = on ? "Pause" : "Play";
  if (on && now >= last - step) seek(first);
  if (hasVideo) { video.playbackRate = Number(element("rate").value); if (on) video.play().catch(() => {}); else video.pause(); }
  if (on) requestAnimationFrame(tick);
}

function lost() {
  hasVideo = false;
  element("trouble").textContent = "The video cannot be played here: the overlay is drawn without it.";
  draw();
}

video.addEventListener("error", lost);
element("play").onclick = () => play(!playing);
element("back").onclick = () => { play(false); seek(times[Math.max(frameAt(now) - 1, 0)]); };
element("on").onclick = () => { play(false); seek(times[Math.min(frameAt(now) + 1, times.length - 1)]); };
element("rate").onchange = () => { video.playbackRate = Number(element("rate").value); };
for (const id of ["court", "flights", "doubt", "spots"]) element(id).onchange = draw;
const space = element("space");
space.onpointerdown = event => space.setPointerCapture(event.pointerId);
space.onpointermove = event => {
  if (!event.buttons) return;
  turn.azimuth -= 0.008 * event.movementX;
  turn.height = Math.min(Math.max(turn.height + 0.008 * event.movementY, 0.02), 1.5);
  drawSpace();
};
space.onwheel = event => { event.preventDefault(); turn.away = Math.min(Math.max(turn.away * Math.exp(0.001 * event.deltaY), 2.5), 20); drawSpace(); };
fillTable();
drawAbove();
drawLine();
window.onresize = () => { drawLine(); draw(); };
if (!hasVideo) lost();
seek(page.strokes.length ? page.strokes[0].t_start + 0.2 : first);
