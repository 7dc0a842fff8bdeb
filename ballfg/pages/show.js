// Draws the chosen shot. The data come from the element `data`: lengths in m, times in s since the shot's first stamp.
"use strict";

const page = JSON.parse(document.getElementById("data").textContent);
const element = id => document.getElementById(id);
const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
const AXES = ["x", "y", "z"];
const AXIS_COLOURS = ["#0072b2", "#e69f00", "#009e73"];
const ESTIMATE = "#0072b2", PREDICTION = "#d55e00", SPIN = "#aa4499", TABLE = "#2f7d6b";
const LABELS = {held: "#cc79a7", rolling: "#999933", resting: "#666666", lost: "#dd3311"};  // what is no flight
const BAND = page.half_width;
const RING = 12;            // corners of a tube's cross-section
const ARROWS = 14;          // spin axes that are drawn along a shot
const SPIN_LENGTH = 0.001;  // m of an arrow for each rad/s
const CAMERA = "#a6761d";
const FARTHEST = 3;         // of a room's longest side: a camera beyond that stays outside of it, and its rays are cut
const MARGIN = 0.4;         // m about the samples, the estimate and the table
const CONFIG = {responsive: true, displaylogo: false, displayModeBar: false};

let shot = null;
let ballTrace = -1;
let playing = null;

const hasStates = () => shot.state_t.length > 0;
const hasPredictions = () => shot.predicted_t.length > 0;
const pathTimes = () => hasStates() ? shot.state_t : shot.t.length ? shot.t : shot.predicted_t;
const pathPlaces = () => hasStates() ? shot.states.slice(0, 3) : shot.t.length ? shot.positions : shot.predicted;
const mm = value => value === null || value === undefined ? "unknown" : (1000 * value).toPrecision(3) + " mm";
const metres = (value, digits) => value === null ? "unknown" : value.toFixed(digits) + " m";

function layout(extra) {
  const line = {gridcolor: colour("--line"), zerolinecolor: colour("--line")};
  const base = {
    margin: {l: 58, r: 12, t: 12, b: 44}, paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)",
    font: {color: colour("--ink"), family: "system-ui, sans-serif", size: 12},
    legend: {orientation: "h", y: -0.24, yanchor: "top", x: 0}, hovermode: "closest",
    hoverlabel: {align: "left"},
  };
  const merged = {...base, ...extra};
  for (const key of Object.keys(merged)) {
    if (/^[xy]axis/.test(key)) merged[key] = {...line, ...merged[key]};
  }
  return merged;
}

function polyline(points, name, style) {
  return {type: "scatter3d", mode: "lines", name, hoverinfo: "skip", showlegend: false,
          x: points.map(p => p[0]), y: points.map(p => p[1]), z: points.map(p => p[2]), ...style};
}

function rectangle(corners, style) {
  return {type: "mesh3d", x: corners.map(c => c[0]), y: corners.map(c => c[1]), z: corners.map(c => c[2]),
          i: [0, 0], j: [1, 2], k: [2, 3], hoverinfo: "skip", showlegend: false, ...style};
}

function surroundings() {
  const table = page.table;
  if (table === null) return [];
  const [x0, x1, y0, y1] = table.extent, h = table.height;
  const at = z => [[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]];
  const border = {line: {color: TABLE, width: 4}};
  const traces = [rectangle(at(h), {color: TABLE, opacity: 0.35}), polyline([...at(h), at(h)[0]], "table", border)];
  if (table.net !== null) {
    const net = table.net;
    traces.push(rectangle(net, {color: "#888888", opacity: 0.35}));
    traces.push(polyline([...net, net[0]], "net", {line: {color: "#888888", width: 2}}));
  }
  if (table.floor !== null) {
    const m = MARGIN;
    const corners = [[x0 - m, y0 - m], [x1 + m, y0 - m], [x1 + m, y1 + m], [x0 - m, y1 + m]].map(c => [...c, table.floor]);
    traces.push(rectangle(corners, {color: "#999999", opacity: 0.12}));
    traces.push(polyline([...corners, corners[0]], "floor", {line: {color: "#999999", width: 1}}));
  }
  return traces;
}

// A tube about a path: rings across the flight, as wide as the standard deviations in these directions.
function tube(times, places, sigmas, correlations, scale, style) {
  const rows = places[0].map((_, i) => i).filter(i => [...sigmas, ...places].every(s => s[i] !== null));
  if (rows.length < 2) return [];
  const x = [], y = [], z = [], faces = [[], [], []];
  rows.forEach((row, number) => {
    const before = rows[Math.max(number - 1, 0)], after = rows[Math.min(number + 1, rows.length - 1)];
    const along = unit(places.map(p => p[after] - p[before]));
    const side = unit(Math.abs(along[2]) < 0.9 ? [along[1], -along[0], 0] : [0, along[2], -along[1]]);
    const up = cross(along, side);
    const variance = spreadIn(sigmas.map(s => s[row]), correlations.map(r => r[row]));
    const wide = Math.sqrt(Math.max(variance(side, side), 0)), both = wide > 0 ? variance(side, up) / wide : 0;
    const high = Math.sqrt(Math.max(variance(up, up) - both * both, 0));
    for (let k = 0; k < RING; k++) {
      const c = Math.cos(2 * Math.PI * k / RING), s = Math.sin(2 * Math.PI * k / RING);
      const at = [0, 1, 2].map(a => places[a][row] + scale * BAND * (c * wide * side[a] + (c * both + s * high) * up[a]));
      x.push(at[0]); y.push(at[1]); z.push(at[2]);
      if (number === 0 || times[row] - times[rows[number - 1]] > shot.gap) continue;
      const a = RING * number + k, b = RING * number + (k + 1) % RING;
      faces[0].push(a, b); faces[1].push(b, b - RING); faces[2].push(a - RING, a - RING);
    }
  });
  return [{type: "mesh3d", x, y, z, i: faces[0], j: faces[1], k: faces[2], opacity: 0.3, hoverinfo: "skip",
           flatshading: false, showlegend: true, ...style}];
}

// The covariance of what is left of a place in two directions.
function spreadIn(sigmas, correlations) {
  const [xy, xz, yz] = correlations.length ? correlations : [0, 0, 0], rho = [[1, xy, xz], [xy, 1, yz], [xz, yz, 1]];
  return (u, v) => {
    let sum = 0;
    for (let a = 0; a < 3; a++) for (let b = 0; b < 3; b++) sum += u[a] * sigmas[a] * rho[a][b] * sigmas[b] * v[b];
    return sum;
  };
}

// Pyramids of the cameras that saw the shot, and some of their rays to the ball.
function cameras() {
  const traces = [];
  for (const rays of shot.rays) {
    const camera = page.cameras.find(one => one.name === rays.camera), [a, b, c, d] = camera.corners, p = camera.place;
    const name = `camera ${camera.name}, ${distance(p).toFixed(1)} m away`, line = {color: CAMERA, width: 3};
    traces.push(polyline([p, a, b, p, c, d, p, a, d, c, b], name, {line, showlegend: true}));
    const path = axis => rays.from[axis].flatMap((from, i) => [from, rays.to[axis][i], null]);
    traces.push({type: "scatter3d", mode: "lines", x: path(0), y: path(1), z: path(2), name: "its rays to the ball",
                 line: {color: CAMERA, width: 1}, opacity: 0.6, hoverinfo: "skip"});
  }
  return traces;
}

// m from a place to the middle of the shot.
function distance(place) {
  const middle = pathPlaces().slice(0, 3).map(row => row[Math.floor(row.length / 2)]);
  return Math.hypot(...place.map((value, a) => value - middle[a]));
}

function unit(v) {
  const length = Math.hypot(...v);
  return length > 0 ? v.map(c => c / length) : [1, 0, 0];
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function cloud(places, times, words, style) {
  return {type: "scatter3d", x: places[0], y: places[1], z: places[2],
          text: times.map((t, i) => words(t, i)), hovertemplate: "%{text}<extra></extra>", ...style};
}

// A line that is not drawn where samples are missing: between its ends there nothing is known.
function broken(trace, times) {
  const gaps = times.map((t, i) => i > 0 && t - times[i - 1] > shot.gap);
  const cut = (values, filler) => values.flatMap((value, i) => gaps[i] ? [filler, value] : [value]);
  const result = {...trace, connectgaps: false};
  for (const key of ["x", "y", "z", "text"]) {
    if (Array.isArray(trace[key])) result[key] = cut(trace[key], key === "text" ? "" : null);
  }
  return result;
}

const placeWords = (places, i) => AXES.map((a, k) => `${a} ${metres(places[k][i], 4)}`).join("<br>");

function spread(sigmas, i) {
  return sigmas.every(s => s[i] === null) ? "" : "<br>standard deviations " + sigmas.map(s => mm(s[i])).join(", ");
}

function spinArrows() {
  const count = shot.state_t.length, traces = [];
  const every = Math.max(1, Math.ceil(count / ARROWS));
  const x = [], y = [], z = [], heads = {x: [], y: [], z: [], u: [], v: [], w: [], text: []};
  for (let i = 0; i < count; i += every) {
    const spin = shot.states.slice(6, 9).map(s => s[i]);
    const from = shot.states.slice(0, 3).map(p => p[i]);
    if ([...spin, ...from].includes(null) || !flies(i)) continue;
    const to = from.map((p, a) => p + SPIN_LENGTH * spin[a]);
    x.push(from[0], to[0], null); y.push(from[1], to[1], null); z.push(from[2], to[2], null);
    heads.x.push(to[0]); heads.y.push(to[1]); heads.z.push(to[2]);
    const way = unit(spin);
    heads.u.push(way[0]); heads.v.push(way[1]); heads.w.push(way[2]);
    heads.text.push(`spin ${Math.hypot(...spin).toFixed(0)} rad/s<br>` +
                    AXES.map((a, k) => `${a} ${spin[k].toFixed(0)} rad/s`).join("<br>"));
  }
  if (!heads.x.length) return traces;
  traces.push({type: "scatter3d", mode: "lines", x, y, z, name: "spin axis, 0.1 m for 100 rad/s", legendgroup: "spin",
               line: {color: SPIN, width: 4}, hoverinfo: "skip"});
  traces.push({type: "cone", ...heads, sizemode: "absolute", sizeref: 0.35, anchor: "tip", showscale: false,
               legendgroup: "spin", colorscale: [[0, SPIN], [1, SPIN]], hovertemplate: "%{text}<extra></extra>"});
  return traces;
}

function marks() {
  const kinds = [["contact", "diamond", "#117733"], ["hit", "x", "#cc3311"]], traces = [];
  for (const [kind, symbol, tint] of kinds) {
    const found = shot.marks.filter(mark => mark.kind === kind);
    if (!found.length) continue;
    const places = [0, 1, 2].map(a => found.map(mark => mark.place[a]));
    traces.push(cloud(places, found.map(mark => mark.t), (t, i) => `${kind} at ${t.toFixed(4)} s<br>${placeWords(places, i)}`,
                      {mode: "markers", name: kind, marker: {symbol, size: 6, color: tint}}));
  }
  return traces;
}

// Rows of the states with a label, or of flight where none has one.
const labelled = label => shot.state_t.map((_, i) => i).filter(i => (shot.labels[i] ?? "flight") === label);
const flies = i => ["flight", "lost"].includes(shot.labels[i] ?? "flight");
const flying = row => shot.labels.length ? row.map((value, i) => flies(i) ? value : null) : row;

function others(place) {
  return Object.entries(LABELS).map(([label, tint]) => [label, tint, labelled(label)]).filter(one => one[2].length)
    .map(([label, tint, rows]) => place(label, tint, rows));
}

const withCameras = () => element("cameras") !== null && element("cameras").value === "shown";

// From where to where each axis goes: about the samples, the estimate and the table, and about cameras nearby that are
// shown. A prediction past a hit goes anywhere.
function room() {
  const table = page.table === null ? [[], [], []] : [page.table.extent.slice(0, 2), page.table.extent.slice(2),
                                                      [page.table.height, page.table.floor ?? page.table.height]];
  const known = shot.t.length || hasStates() ? [shot.positions, shot.states] : [shot.predicted];
  const around = places => [0, 1, 2].map(a => {
    const values = [...table[a], ...known.flatMap(rows => rows[a] ?? []), ...places.map(place => place[a])].filter(value => value !== null);
    return [Math.min(...values) - MARGIN, Math.max(...values) + MARGIN];
  });
  const seen = withCameras() ? shot.rays.map(rays => page.cameras.find(one => one.name === rays.camera).place) : [];
  const longest = Math.max(...around([]).map(([low, high]) => high - low));
  return around(seen.filter(place => distance(place) < FARTHEST * longest));
}

function drawSpace() {
  const scale = Number(element("scale").value), traces = surroundings();
  if (shot.t.length) {
    traces.push(cloud(shot.positions, shot.t, (t, i) => `measured at ${t.toFixed(4)} s<br>${placeWords(shot.positions, i)}`,
                      {mode: "markers", name: "measured", marker: {size: 2.5, color: colour("--quiet")}}));
  }
  if (hasStates()) {
    const places = shot.states.slice(0, 3), velocity = shot.states.slice(3, 6);
    const words = (t, i) => `estimate at ${t.toFixed(4)} s<br>${placeWords(places, i)}<br>speed ` +
      `${Math.hypot(...velocity.map(v => v[i])).toFixed(2)} m/s${spread(shot.state_sigmas, i)}`;
    const style = {mode: "lines", name: "estimate", line: {color: ESTIMATE, width: 5}};
    traces.push(broken(cloud(places.map(flying), shot.state_t, words, style), shot.state_t));
    traces.push(...tube(shot.state_t, places, shot.state_sigmas.map(flying), shot.correlations, scale, {color: ESTIMATE, name: "its 90 % tube"}));
    traces.push(...others((label, tint, rows) => cloud(places.map(p => rows.map(i => p[i])), rows.map(i => shot.state_t[i]),
      t => `${label} at ${t.toFixed(4)} s`, {mode: "markers", name: label, marker: {size: 3.5, color: tint}})));
  }
  if (hasPredictions()) {
    const words = (t, i) => `predicted for ${t.toFixed(4)} s<br>${placeWords(shot.predicted, i)}${spread(shot.predicted_sigmas, i)}`;
    const style = {mode: "lines", name: "prediction", line: {color: PREDICTION, width: 5}};
    traces.push(broken(cloud(shot.predicted, shot.predicted_t, words, style), shot.predicted_t));
    traces.push(...tube(shot.predicted_t, shot.predicted, shot.predicted_sigmas, [], scale, {color: PREDICTION, name: "90 % tube of a measurement"}));
  }
  traces.push(...marks(), ...spinArrows(), ...(withCameras() ? cameras() : []));
  ballTrace = traces.length;
  traces.push({type: "scatter3d", mode: "markers", name: "ball at the chosen time", x: [0], y: [0], z: [0], hoverinfo: "skip",
               marker: {size: 8, color: "#f5a623", line: {color: "#333333", width: 1}}});
  const range = room();
  const axis = (name, a) => ({title: {text: `${name}, m`}, range: range[a], gridcolor: colour("--line"),
                              color: colour("--ink"), showspikes: false});
  const size = pathPlaces().slice(0, 2).map(row => Math.max(...row) - Math.min(...row));
  const alongY = size[1] > size[0], narrow = element("space").clientWidth < 520;
  // the longest axis, in units of the cube that plotly draws, fits into the picture
  const lengths = range.map(([low, high]) => high - low);
  const longest = Math.max(...lengths) / Math.cbrt(lengths.reduce((product, length) => product * length));
  const [ahead, aside, above] = (narrow ? [0.6, 1.85, 0.62] : [0.38, 1.22, 0.42]).map(part => part * longest);
  const eye = alongY ? {x: aside, y: ahead, z: above} : {x: ahead, y: -aside, z: above};  // from the side of the flight
  const scene = {aspectmode: "data", xaxis: axis("x", 0), yaxis: axis("y", 1), zaxis: axis("z", 2),
                 camera: {center: {x: 0, y: 0, z: -0.12}, eye}, uirevision: alongY ? "y" : "x"};
  const drawn = {margin: {l: 0, r: 0, t: 0, b: 0}, scene, legend: {orientation: "h", x: 0, y: 0, yanchor: "top"}};
  Plotly.react("space", traces, layout(drawn), CONFIG);
}

function line(x, y, extra) {
  return {type: "scatter", x, y, ...extra};
}

// The band between low and high; rows without a standard deviation, and steps longer than a gap, interrupt it.
function band(times, middle, sigmas, tint, extra) {
  const x = [], y = [], runs = [[]];
  times.forEach((t, i) => {
    const known = middle[i] !== null && sigmas[i] !== null;
    if (!known || (i > 0 && t - times[i - 1] > shot.gap)) runs.push([]);
    if (known) runs.at(-1).push(i);
  });
  const add = (i, side) => { x.push(times[i]); y.push(middle[i] + side * BAND * sigmas[i]); };
  for (const run of runs.filter(rows => rows.length)) {
    run.forEach(i => add(i, 1));
    run.slice().reverse().forEach(i => add(i, -1));
    x.push(null); y.push(null);
  }
  return {type: "scatter", mode: "lines", x, y, fill: "toself", fillcolor: tint + "33", line: {width: 0}, hoverinfo: "skip",
          showlegend: false, ...extra};
}

function stacked(titles, unit) {
  const extra = {grid: {rows: 3, columns: 1, pattern: "coupled"}, xaxis: {title: {text: "time, s"}},
                 legend: {orientation: "h", y: -0.12, yanchor: "top", x: 0}};
  titles.forEach((title, a) => { extra[a ? `yaxis${a + 1}` : "yaxis"] = {title: {text: `${title}, ${unit}`}}; });
  return layout(extra);
}

function drawByAxis() {
  const traces = [];
  for (let a = 0; a < 3; a++) {
    const on = {yaxis: a ? `y${a + 1}` : "y"}, hovertemplate = `%{x:.4f} s: ${AXES[a]} = %{y:.4f} m`;
    const first = name => ({name, legendgroup: name, showlegend: a === 0, hovertemplate, ...on});
    if (shot.t.length) {
      traces.push(line(shot.t, shot.positions[a], {mode: "markers", marker: {size: 4, color: colour("--quiet")}, ...first("measured")}));
    }
    if (hasPredictions()) {
      traces.push(band(shot.predicted_t, shot.predicted[a], shot.predicted_sigmas[a], PREDICTION, on));
      const style = {mode: "lines", line: {color: PREDICTION}, ...first("prediction")};
      traces.push(broken(line(shot.predicted_t, shot.predicted[a], style), shot.predicted_t));
    }
    if (hasStates()) {
      traces.push(band(shot.state_t, shot.states[a], flying(shot.state_sigmas[a]), ESTIMATE, on));
      const style = {mode: "lines", line: {color: ESTIMATE, width: 1.5}, ...first("estimate")};
      traces.push(broken(line(shot.state_t, flying(shot.states[a]), style), shot.state_t));
      traces.push(...others((label, tint, rows) => line(rows.map(i => shot.state_t[i]), rows.map(i => shot.states[a][i]),
        {mode: "markers", marker: {size: 4, color: tint}, ...first(label)})));
    }
  }
  Plotly.react("axes", traces, stacked(AXES, "m"), CONFIG);
}

function drawErrors() {
  const traces = [];
  for (let a = 0; a < 3; a++) {
    const on = {yaxis: a ? `y${a + 1}` : "y"}, error = shot.prediction_errors[a].map(e => e === null ? null : 1000 * e);
    const zero = error.map(() => 0), sigma = shot.predicted_sigmas[a].map(s => s === null ? null : 1000 * s);
    traces.push(band(shot.predicted_t, zero, sigma, PREDICTION, {...on, name: "90 % interval", showlegend: a === 0}));
    const style = {mode: "markers+lines", marker: {size: 4}, line: {width: 1, color: AXIS_COLOURS[a]}, name: AXES[a],
                   hovertemplate: `%{x:.4f} s: %{y:.1f} mm in ${AXES[a]}<extra></extra>`, ...on};
    traces.push(broken(line(shot.predicted_t, error, style), shot.predicted_t));
  }
  Plotly.react("errors", traces, stacked(AXES, "mm"), CONFIG);
}

function drawResiduals() {
  const inMm = shot.residuals.map(row => row.map(r => r === null ? null : 1000 * r));
  const whitened = shot.residuals.map((row, a) => row.map((r, i) => {
    const sigma = Array.isArray(shot.noise[a]) ? shot.noise[a][i] : shot.noise[a];
    return r === null || sigma === null ? null : r / sigma;
  }));
  const dots = (rows, unit, most) => rows.map((row, a) => {
    const symbol = ["circle", "diamond", "square"][a];
    const drawn = row.map(r => r === null ? null : Math.max(-most, Math.min(most, r)));
    return line(shot.t, drawn, {
      mode: "markers", name: AXES[a], customdata: row,
      marker: {size: 5, color: AXIS_COLOURS[a], symbol: row.map(r => Math.abs(r) > most ? symbol + "-open" : symbol)},
      hovertemplate: `%{x:.4f} s: %{customdata:.2f} ${unit}<extra>${AXES[a]}</extra>`});
  });
  const time = {title: {text: "time, s"}};
  Plotly.react("residuals", dots(inMm, "mm", Infinity), layout({xaxis: time, yaxis: {title: {text: "residual, mm"}}}), CONFIG);
  if (element("whitened") === null) return;
  const lines = [-BAND, BAND].map(y => ({type: "line", xref: "paper", x0: 0, x1: 1, y0: y, y1: y,
                                         line: {dash: "dash", width: 1, color: colour("--quiet")}}));
  const drawn = layout({xaxis: time, yaxis: {title: {text: "standard deviations"}}, shapes: lines});
  Plotly.react("whitened", dots(whitened, "standard deviations", page.largest), drawn, CONFIG);
}

function drawCoverage() {
  const held = page.coverage;
  const traces = AXES.map((a, k) => line(held.horizons, held.shares.map(row => 100 * row[k]), {
    mode: "lines+markers", name: a, line: {color: AXIS_COLOURS[k]}, marker: {size: 5},
    text: held.samples.map((n, i) => `${n} samples of ${held.shots[i]} shots`),
    hovertemplate: "%{x:.3f} s ahead: %{y:.0f} % inside<br>%{text}<extra>" + a + "</extra>"}));
  const right = [{type: "line", xref: "paper", x0: 0, x1: 1, y0: page.level, y1: page.level,
                  line: {dash: "dash", color: colour("--ink"), width: 1.5}}];
  const drawn = layout({xaxis: {title: {text: "horizon, s"}, rangemode: "tozero"}, shapes: right,
                        yaxis: {title: {text: "inside the interval, %"}, range: [0, 103]}});
  Plotly.react("coverage", traces, drawn, CONFIG);
}

function drawDiagnosis() {
  const found = page.diagnosis;
  const order = found.before.map((_, i) => i).sort((i, j) => found.before[i] - found.before[j]);
  const series = [["before", found.before, PREDICTION], ["after", found.after, ESTIMATE]];
  const traces = series.filter(row => row[1] !== null).map(([name, values, tint]) => line(
    order.map((_, k) => k + 1), order.map(i => values[i]),
    {mode: "markers", name, marker: {color: tint, size: 7}, hovertemplate: `%{y:.1f} mm ${name}<extra></extra>`}));
  Plotly.react("tracks", traces, layout({xaxis: {title: {text: "held-out tracks, in order of their error before"}},
               yaxis: {title: {text: "prediction error, mm"}, rangemode: "tozero"}}), CONFIG);
  if (element("candidates") === null) return;
  const names = found.candidates.map(c => c.name).reverse(), sizes = found.candidates.map(c => c.explained).reverse();
  Plotly.react("candidates", [{type: "bar", orientation: "h", x: sizes, y: names, marker: {color: ESTIMATE},
               text: found.candidates.map(c => c.outcome).reverse(), textposition: "none",
               hovertemplate: "%{y}: %{x:.3g}<br>%{text}<extra></extra>"}],
               layout({xaxis: {title: {text: "squared residual explained"}, type: "log"}, yaxis: {type: "category", automargin: true}}), CONFIG);
}

function showMoment() {
  const i = Number(element("moment").value), times = pathTimes(), places = pathPlaces();
  const words = [`t = ${times[i].toFixed(3)} s`, AXES.map((a, k) => `${a} ${metres(places[k][i], 3)}`).join(", ")];
  if (hasStates()) {
    const [velocity, spin] = [shot.states.slice(3, 6), shot.states.slice(6, 9)].map(part => part.map(row => row[i]));
    words[1] += ` (± ${shot.state_sigmas.map(s => mm(s[i])).join(", ")})`;
    if (shot.labels.length) words.push(shot.labels[i]);
    if (flies(i) && !velocity.includes(null)) words.push(`speed ${Math.hypot(...velocity).toFixed(2)} m/s`);
    if (flies(i) && !spin.includes(null)) words.push(`spin ${Math.hypot(...spin).toFixed(0)} rad/s`);
  }
  element("readout").textContent = words.join(" · ");
  Plotly.restyle("space", {x: [[places[0][i]]], y: [[places[1][i]]], z: [[places[2][i]]]}, [ballTrace]);
}

function stop() {
  clearInterval(playing);
  playing = null;
  element("play").textContent = "Play";
}

function play() {
  if (playing !== null) return stop();
  const times = pathTimes(), slider = element("moment"), last = times.length - 1;
  if (Number(slider.value) >= last) slider.value = 0;
  const began = performance.now(), from = times[Number(slider.value)];
  element("play").textContent = "Stop";
  playing = setInterval(() => {
    const now = from + (performance.now() - began) / 1000 * Number(element("speed").value);
    while (Number(slider.value) < last && times[Number(slider.value) + 1] <= now) slider.value = Number(slider.value) + 1;
    showMoment();
    if (Number(slider.value) >= last) stop();
  }, 50);
}

function choose(index) {
  stop();
  shot = page.shots[index];
  element("moment").max = pathTimes().length - 1;
  element("moment").value = 0;
  drawSpace();
  drawByAxis();
  if (element("residuals") !== null) drawResiduals();
  if (element("errors") !== null) drawErrors();
  showMoment();
}

if (page.shots.length) {
  element("shot").addEventListener("change", event => choose(event.target.selectedIndex));
  element("scale").addEventListener("change", () => { drawSpace(); showMoment(); });
  if (element("cameras") !== null) element("cameras").addEventListener("change", () => { drawSpace(); showMoment(); });
  element("moment").addEventListener("input", () => { stop(); showMoment(); });
  element("play").addEventListener("click", play);
  choose(0);
}
if (page.coverage !== null) drawCoverage();
if (page.diagnosis !== null) drawDiagnosis();
