"use strict";
const $ = (id) => document.getElementById(id);
const page = JSON.parse($("payload").textContent);
const types = { uint8: Uint8Array, uint16: Uint16Array, uint32: Uint32Array, float32: Float32Array };
const H = page.height, W = page.width;
const state = { row: H >> 1, column: W >> 1, layer: 0, whole: false, frame: 0, playing: false };
const INK = "#1a1d21", BARS = "#8b93a0", LINE = "#0072b2", DIRECT = "#009e73", INDIRECT = "#d55e00", MARK = "#e69f00";

async function unpacked(text, type) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new types[type](await new Response(stream).arrayBuffer());
}
const short = (v) => v && (Math.abs(v) < .01 || Math.abs(v) >= 1e5) ? v.toExponential(1) : number(v, 3);
const number = (v, digits = 4) => !Number.isFinite(v) ? "none" : v === 0 ? "0" : Number(v.toPrecision(digits)).toString();
const clamp = (v, low, high) => Math.min(Math.max(v, low), high);

function colour(palette, share) {
  const stops = page.palettes[palette], at = clamp(share, 0, 1) * (stops.length - 1), k = Math.min(Math.floor(at), stops.length - 2);
  return [0, 1, 2].map((c) => stops[k][c] + (at - k) * (stops[k + 1][c] - stops[k][c]));
}
function paint(canvas, values, palette, low, high, gamma = 1) {
  canvas.width = W; canvas.height = H;
  const context = canvas.getContext("2d"), picture = context.createImageData(W, H);
  for (let i = 0; i < W * H; i++) {
    const known = Number.isFinite(values[i]);
    const rgb = known ? colour(palette, Math.pow(clamp((values[i] - low) / (high - low || 1), 0, 1), gamma)) : [200, 200, 200];
    picture.data.set([...rgb, 255], 4 * i);
  }
  context.putImageData(picture, 0, 0);
}
function cross(canvas) {
  const context = canvas.getContext("2d");
  context.strokeStyle = MARK; context.lineWidth = Math.max(1, W / 128);
  const r = Math.max(2, W / 32);
  context.beginPath(); context.arc(state.column + .5, state.row + .5, r, 0, 2 * Math.PI); context.stroke();
}

function value(cube, pixel, bin) {
  const v = cube.values[pixel * cube.bins + bin];
  return cube.rooted ? cube.table[v] : v;
}
function drawImage() {
  if (!page.layers.length) return;
  const layer = page.layers[state.layer], canvas = $("image");
  paint(canvas, layer.values, layer.palette, layer.low, layer.high, layer.palette === "gray" ? 1 / 2.2 : 1);
  cross(canvas);
  const stops = page.palettes[layer.palette].map((c) => `rgb(${c.map(Math.round).join()})`);
  $("scale").style.background = `linear-gradient(90deg, ${stops.join()})`;
  $("low").textContent = number(layer.low, 3); $("high").textContent = `${number(layer.high, 3)} ${layer.unit}`;
}
function tell() {
  if (!page.layers.length) return;
  const pixel = state.row * W + state.column;
  const parts = page.layers.map((l) => `${l.name} ${number(l.values[pixel])} ${l.unit}`.trim());
  if (page.returns) {
    const [a, b] = [page.returns.offsets[pixel], page.returns.offsets[pixel + 1]];
    let direct = 0, late = 0;
    for (let i = a; i < b; i++) page.returns.direct[i] ? direct += page.returns.energy[i] : late += page.returns.energy[i];
    parts.push(`direct returns ${number(direct)}, indirect ${number(late)}`);
  }
  $("told").textContent = `Row ${state.row}, column ${state.column}: ${parts.join("; ")}`;
}

function range(pixel) {
  const cube = page.cubes[0], end = cube.start_ns + cube.bins * cube.step_ns;
  if (state.whole) return [cube.start_ns, end];
  const last = page.cubes[page.cubes.length - 1], arrival = page.arrival ? page.arrival[pixel] : NaN;
  let peak = 0, at = cube.start_ns;
  for (let t = 0; t < last.bins; t++) { const v = value(last, pixel, t); if (v > peak) { peak = v; at = last.start_ns + t * last.step_ns; } }
  const centre = arrival < end ? arrival : at, span = Math.max(22, 60 * cube.step_ns);
  const low = clamp(centre - .2 * span, cube.start_ns, Math.max(cube.start_ns, end - span));
  return [low, Math.min(low + span, end)];
}
function drawPlot() {
  if (!page.cubes.length) return;
  const canvas = $("plot"), ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio; canvas.height = height * ratio;
  const c = canvas.getContext("2d"); c.scale(ratio, ratio); c.font = "12px system-ui, sans-serif";
  const pixel = state.row * W + state.column, [low, high] = range(pixel);
  const left = 48, right = width - 12, middle = page.returns ? height * .36 : 18, bottom = height - 34;
  const x = (t) => left + (t - low) / (high - low) * (right - left);
  let top = 0;
  for (const cube of page.cubes) for (let t = 0; t < cube.bins; t++) {
    const at = cube.start_ns + (t + .5) * cube.step_ns; if (at >= low && at <= high) top = Math.max(top, value(cube, pixel, t));
  }
  const y = (v) => bottom - v / (top * 1.08 || 1) * (bottom - middle - 14);
  c.strokeStyle = "#c9ced6"; c.fillStyle = INK; c.textAlign = "center";
  const step = nice((high - low) / Math.max(3, Math.floor((right - left) / 90)));
  for (let t = Math.ceil(low / step) * step; t <= high; t += step) {
    c.beginPath(); c.moveTo(x(t), 8); c.lineTo(x(t), bottom); c.stroke();
    c.fillText(number(t, 6), x(t), bottom + 14);
  }
  const metres = page.cubes[0].metres_per_ns, deep = metres && right - left > 380 ? `; 1 ns is ${number(metres, 4)} m of depth` : "";
  c.fillText(`time since emission [ns]${deep}`, (left + right) / 2, height - 5);
  c.textAlign = "right"; for (const v of [0, top]) c.fillText(short(v), left - 4, y(v) + 4);
  c.save(); c.beginPath(); c.rect(left, 0, right - left, bottom + 1); c.clip();
  for (const cube of page.cubes) cube.drawn === "bars" ? bars(c, cube, pixel, x, y, low, high) : curve(c, cube, pixel, x, y, low, high);
  const shown = page.cubes[0];
  if (page.arrival) { if (Number.isFinite(page.arrival[pixel])) { c.strokeStyle = INK; c.setLineDash([2, 3]); const at = x(page.arrival[pixel]); c.beginPath(); c.moveTo(at, 8); c.lineTo(at, bottom); c.stroke(); c.setLineDash([]); } }
  if ($("movie")) { const at = x(shown.start_ns + (state.frame + .5) * shown.step_ns); c.strokeStyle = MARK; c.beginPath(); c.moveTo(at, 8); c.lineTo(at, bottom); c.stroke(); }
  if (page.returns) stems(c, pixel, x, middle);
  c.restore();
}
function nice(step) { const p = Math.pow(10, Math.floor(Math.log10(step))); return [1, 2, 5, 10].map((k) => k * p).find((s) => s >= step); }
function within(cube, low, high) { return [clamp(Math.floor((low - cube.start_ns) / cube.step_ns), 0, cube.bins), clamp(Math.ceil((high - cube.start_ns) / cube.step_ns), 0, cube.bins)]; }
function bars(c, cube, pixel, x, y, low, high) {
  c.fillStyle = BARS; const [a, b] = within(cube, low, high);
  for (let t = a; t < b; t++) { const v = value(cube, pixel, t), at = cube.start_ns + t * cube.step_ns; if (v) c.fillRect(x(at), y(v), Math.max(1, x(at + cube.step_ns) - x(at)), y(0) - y(v)); }
}
function curve(c, cube, pixel, x, y, low, high) {
  c.strokeStyle = LINE; c.lineWidth = 1.6; c.beginPath(); const [a, b] = within(cube, low, high);
  for (let t = a; t < b; t++) { const v = y(value(cube, pixel, t)), at = cube.start_ns + t * cube.step_ns; c.lineTo(x(at), v); c.lineTo(x(at + cube.step_ns), v); }
  c.stroke(); c.lineWidth = 1;
}
function stems(c, pixel, x, middle) {
  const r = page.returns, [a, b] = [r.offsets[pixel], r.offsets[pixel + 1]];
  let top = 0; for (let i = a; i < b; i++) top = Math.max(top, r.energy[i]);
  const scale = (e) => Math.max(0, 1 + Math.log10(e / top) / 4) * (middle - 16);
  c.strokeStyle = INK; c.beginPath(); c.moveTo(0, middle); c.lineTo(1e5, middle); c.stroke();
  for (let i = a; i < b; i++) if (r.energy[i] > 0) {
    const at = x(r.time[i]), tip = middle - scale(r.energy[i]);
    c.strokeStyle = c.fillStyle = r.direct[i] ? DIRECT : INDIRECT;
    c.beginPath(); c.moveTo(at, middle); c.lineTo(at, tip); c.stroke();
    c.beginPath(); r.direct[i] ? c.arc(at, tip, 3, 0, 7) : c.rect(at - 2, tip - 2, 4, 4); c.fill();
  }
}

function movieCube() { return page.cubes[page.cubes.length - 1]; }
function drawMovie() {
  if (!page.cubes.length) return;
  const cube = movieCube(), frame = new Float32Array(W * H), reach = cube.drawn === "bars" ? 4 : 0;
  for (let p = 0; p < W * H; p++) {
    let sum = 0; for (let t = Math.max(0, state.frame - reach); t <= Math.min(cube.bins - 1, state.frame + reach); t++) sum += value(cube, p, t);
    frame[p] = sum - (cube.base ? cube.base[p] : 0);
  }
  paint($("movie"), frame, "light", 0, cube.white * (reach ? 3 : 1), 1 / 2.2); cross($("movie"));
  const at = cube.start_ns + (state.frame + .5) * cube.step_ns;
  $("when").textContent = `${number(at, 5)} ns` + (cube.metres_per_ns ? `, ${number(at * cube.metres_per_ns, 4)} m deep` : "");
  $("time").value = state.frame;
}
function prepareMovie() {
  const cube = movieCube(), total = new Float64Array(cube.bins), bright = [];
  for (let p = 0; p < W * H; p++) for (let t = 0; t < cube.bins; t++) total[t] += value(cube, p, t);
  const steady = Float64Array.from(total).sort()[Math.floor(cube.bins / 2)];
  let first = total.findIndex((v) => v > 1.5 * steady && v > 0); if (first < 0) first = 0;
  if (cube.drawn === "line") cube.base = new Float32Array(W * H); // steady light of each pixel, taken away
  for (let p = 0; p < W * H; p++) {
    let most = 0, least = Infinity;
    for (let t = 0; t < cube.bins; t++) { const v = value(cube, p, t); most = Math.max(most, v); least = Math.min(least, v); }
    if (cube.base) cube.base[p] = least;
    bright.push(most - (cube.base ? least : 0));
  }
  bright.sort((a, b) => a - b);
  cube.white = bright[Math.floor(.9 * (bright.length - 1))] || 1;
  $("time").max = cube.bins - 1; state.frame = Math.max(0, first - 2);
  $("time").setAttribute("aria-valuetext", "time bin");
}
let before = 0;
function play(now) {
  if (!state.playing) return;
  if (now - before > 45) { before = now; state.frame = (state.frame + 1) % movieCube().bins; drawMovie(); drawPlot(); }
  requestAnimationFrame(play);
}
function toggle() { state.playing = !state.playing; $("play").textContent = state.playing ? "Pause" : "Play"; $("play").setAttribute("aria-pressed", state.playing); if (state.playing) requestAnimationFrame(play); }
function step(by) { state.frame = clamp(state.frame + by, 0, movieCube().bins - 1); drawMovie(); drawPlot(); }

const view = { yaw: .35, pitch: .2, zoom: 1 };
function drawCloud() {
  const canvas = $("cloud"); if (!canvas) return;
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio; canvas.height = height * ratio;
  const c = canvas.getContext("2d"), p = page.points, n = p.values.length / 3;
  const [cy, sy, cp, sp] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
  const order = new Uint32Array(n), away = new Float32Array(n), at = new Float32Array(2 * n);
  const scale = view.zoom * .9 * Math.min(canvas.width, canvas.height) / (2 * p.radius);
  for (let i = 0; i < n; i++) {
    const [x, y, z] = [0, 1, 2].map((k) => p.values[3 * i + k] - p.centre[k]);
    const u = cy * x - sy * z, w = sy * x + cy * z; order[i] = i; away[i] = cp * w - sp * y;
    at[2 * i] = canvas.width / 2 + scale * u; at[2 * i + 1] = canvas.height / 2 + scale * (cp * y + sp * w);
  }
  order.sort((a, b) => away[b] - away[a]);
  const size = Math.max(1.5, scale * p.spacing);
  for (const i of order) {
    const rgb = colour("depth", p.share[i]), light = p.light ? .55 + .45 * Math.sqrt(p.light[i]) : 1;
    c.fillStyle = `rgb(${rgb.map((v) => Math.round(v * light)).join()})`;
    c.fillRect(at[2 * i] - size / 2, at[2 * i + 1] - size / 2, size, size);
  }
}
function turn(yaw, pitch, zoom = 1) { view.yaw += yaw; view.pitch = clamp(view.pitch + pitch, -1.5, 1.5); view.zoom = clamp(view.zoom * zoom, .2, 20); drawCloud(); }

function pick(row, column) { state.row = clamp(row, 0, H - 1); state.column = clamp(column, 0, W - 1); drawImage(); tell(); drawPlot(); if ($("movie")) drawMovie(); }
function pickable(canvas) {
  const at = (e) => { const box = canvas.getBoundingClientRect(); pick(Math.floor((e.clientY - box.top) / box.height * H), Math.floor((e.clientX - box.left) / box.width * W)); };
  canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); at(e); });
  canvas.addEventListener("pointermove", (e) => { if (e.buttons) at(e); });
  canvas.addEventListener("keydown", (e) => {
    const far = e.shiftKey ? 10 : 1, moves = { ArrowUp: [-far, 0], ArrowDown: [far, 0], ArrowLeft: [0, -far], ArrowRight: [0, far] };
    if (moves[e.key]) { e.preventDefault(); pick(state.row + moves[e.key][0], state.column + moves[e.key][1]); }
    if (e.key === " " && canvas.id === "movie") { e.preventDefault(); toggle(); }
  });
}
function listen() {
  if (page.layers.length) {
    page.layers.forEach((l, i) => $("layer").add(new Option(l.name, i)));
    $("layer").addEventListener("change", (e) => { state.layer = Number(e.target.value); drawImage(); });
    pickable($("image"));
  }
  if (page.cubes.length) {
    pickable($("movie"));
    $("whole").addEventListener("click", () => { state.whole = !state.whole; $("whole").textContent = state.whole ? "Around the first return" : "Whole range"; $("whole").setAttribute("aria-pressed", state.whole); drawPlot(); });
    $("play").addEventListener("click", toggle);
    $("back").addEventListener("click", () => step(-1)); $("on").addEventListener("click", () => step(1));
    $("time").addEventListener("input", (e) => { state.frame = Number(e.target.value); drawMovie(); drawPlot(); });
  }
  const cloud = $("cloud");
  if (cloud) {
    cloud.addEventListener("pointerdown", (e) => cloud.setPointerCapture(e.pointerId));
    cloud.addEventListener("pointermove", (e) => { if (e.buttons) turn(-e.movementX / 150, e.movementY / 150); });
    cloud.addEventListener("wheel", (e) => { e.preventDefault(); turn(0, 0, Math.exp(-e.deltaY / 500)); }, { passive: false });
    cloud.addEventListener("keydown", (e) => {
      const moves = { ArrowLeft: [.1, 0], ArrowRight: [-.1, 0], ArrowUp: [0, -.1], ArrowDown: [0, .1], "+": [0, 0, 1.2], "-": [0, 0, 1 / 1.2] };
      if (moves[e.key]) { e.preventDefault(); turn(...moves[e.key]); }
    });
  }
  window.addEventListener("resize", () => { drawPlot(); drawCloud(); });
}
async function start() {
  if (typeof DecompressionStream === "undefined") throw new Error("this page needs a browser of 2023 or newer");
  for (const layer of page.layers) layer.values = await unpacked(layer.data, "float32");
  for (const cube of page.cubes) {
    cube.values = await unpacked(cube.data, cube.type);
    if (cube.rooted) cube.table = Float64Array.from({ length: 256 }, (_, k) => cube.top * (k / 255) ** 2);
  }
  if (page.arrival_ns) page.arrival = await unpacked(page.arrival_ns, "float32");
  if (page.returns) {
    const r = page.returns, sizes = await unpacked(r.sizes, "uint16"), kind = await unpacked(r.direct_data, "uint8");
    r.offsets = new Uint32Array(sizes.length + 1); sizes.forEach((s, i) => { r.offsets[i + 1] = r.offsets[i] + s; });
    const time = await unpacked(r.time_data, "uint16"), energy = await unpacked(r.energy_data, "uint8");
    r.direct = kind; r.time = new Float64Array(time.length);
    for (let p = 0; p < sizes.length; p++) for (let i = r.offsets[p], t = 0; i < r.offsets[p + 1]; i++) r.time[i] = (t += time[i]) * r.step_ns;
    r.energy = Float64Array.from(energy, (e) => e ? r.top * Math.pow(10, (e / 255 - 1) * r.decades) : 0);
  }
  if (page.points) {
    const p = page.points; p.values = await unpacked(p.data, "float32"); if (p.light) p.light = await unpacked(p.light, "float32");
    const n = p.values.length / 3; p.share = new Float32Array(n);
    for (let i = 0; i < n; i++) p.share[i] = clamp((Math.hypot(...p.values.subarray(3 * i, 3 * i + 3)) - p.low) / (p.high - p.low || 1), 0, 1);
  }
  listen();
  if (page.cubes.length) prepareMovie();
  drawCloud(); if (page.layers.length) pick(state.row, state.column);
  document.body.dataset.ready = "yes";
}
start().catch((error) => { $("problem").textContent = `Nothing can be shown: ${error.message}`; });
