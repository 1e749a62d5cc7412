// The picture in a browser. It speaks foxglove.sdk.v1 with the server that sent this page, as any other viewer does, keeps
// the newest of each sensor, and draws that in the robot's coordinates: x ahead, y to the left, in metres.

const $ = (id) => document.getElementById(id);
const map = $("map");
const pen = map.getContext("2d");

// ---------------------------------------------------------------- what is known

const sensors = new Map(); // by namespace, as "/front"
const poses = new Map(); // by frame: [xx, xy, yx, yy, x, y]
let robot = { verdict: "unknown", sensor: null, nearest_m: null, hub: false, trouble: null };
let circles = [];
let beams = []; // that violate a circle
let marks = [];
let walls = []; // straight surfaces, as pairs of ends
let corners = [];
const people = new Map(); // by topic of their tracker: when they came, and who is where
let player = null; // of the recording that this server plays, if it does
let heard = -Infinity; // when the verdict came last
let frames = 0;
const ages = []; // moment of a scan, and of the end of the frame that shows it, in ms since 1970, by one machine's clock
const drawn = { beams: 0, foreground: 0, zones: 0, marks: 0, lines: 0, tracks: 0 };

const SILENT_MS = 500; // after which the verdict is not known
const OLD_MS = 1000; // after which a scan is not what is there
const TRAIL_MS = 1600;
const TRAIL_STEP_MS = 90;
const HISTORY_MS = 120_000;

function sensorAt(topic) {
  const space = topic.slice(0, topic.lastIndexOf("/"));
  if (!sensors.has(space)) {
    sensors.set(space, { space, name: space.slice(1).replaceAll("/", "."), scans: 0, scan: null, foreground: null,
      background: null, trail: [], status: null, history: [], card: null });
  }
  return sensors.get(space);
}

// ---------------------------------------------------------------- bytes of ROS

/** Little-endian CDR: values at multiples of their size behind four bytes of head. */
class Cdr {
  constructor(buffer, offset) {
    this.view = new DataView(buffer, offset + 4);
    this.at = 0;
  }
  #next(size) {
    this.at = Math.ceil(this.at / size) * size;
    this.at += size;
    return this.at - size;
  }
  u8() { return this.view.getUint8(this.#next(1)); }
  u32() { return this.view.getUint32(this.#next(4), true); }
  f32() { return this.view.getFloat32(this.#next(4), true); }
  f64() { return this.view.getFloat64(this.#next(8), true); }
  text() {
    const length = this.u32();
    const bytes = new Uint8Array(this.view.buffer, this.view.byteOffset + this.at, length - 1);
    this.at += length;
    return new TextDecoder().decode(bytes);
  }
  floats() {
    const count = this.u32();
    const values = new Float32Array(count);
    for (let i = 0; i < count; i++) values[i] = this.view.getFloat32(this.at + 4 * i, true);
    this.at += 4 * count;
    return values;
  }
  frame() {
    this.u32();
    this.u32();
    return this.text();
  }
}

function laserScan(buffer, offset) {
  const cdr = new Cdr(buffer, offset);
  const frame = cdr.frame();
  const [first, last, step, , period, , farthest] = Array.from({ length: 7 }, () => cdr.f32());
  return { frame, first, last, step, period, farthest, ranges: cdr.floats(), intensities: cdr.floats() };
}

/** x and y of each point of a cloud. */
function pointCloud(buffer, offset) {
  const cdr = new Cdr(buffer, offset);
  cdr.frame();
  const count = cdr.u32() * cdr.u32();
  const fields = {};
  for (let n = cdr.u32(); n > 0; n--) {
    const name = cdr.text();
    fields[name] = cdr.u32();
    cdr.u8();
    cdr.u32();
  }
  cdr.u8();
  const step = cdr.u32();
  cdr.u32();
  cdr.u32();
  const xy = new Float32Array(2 * count);
  for (let i = 0; i < count; i++) {
    xy[2 * i] = cdr.view.getFloat32(cdr.at + i * step + fields.x, true);
    xy[2 * i + 1] = cdr.view.getFloat32(cdr.at + i * step + fields.y, true);
  }
  return xy;
}

function transforms(buffer, offset) {
  const cdr = new Cdr(buffer, offset);
  for (let n = cdr.u32(); n > 0; n--) {
    cdr.frame();
    const child = cdr.text();
    const [x, y, , qx, qy, qz, qw] = Array.from({ length: 7 }, () => cdr.f64());
    // The first two rows and columns of the rotation: a sensor upside down is a mirror from above.
    poses.set(child, [1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qz * qw), 2 * (qx * qy + qz * qw),
      1 - 2 * (qx * qx + qz * qz), x, y]);
  }
  isFitDue = true;
}

// ---------------------------------------------------------------- what comes

const SHADES = 24;

function takeScan(topic, buffer, offset) {
  const sensor = sensorAt(topic);
  const told = laserScan(buffer, offset);
  const { ranges, intensities, first, step } = told;
  const points = places(ranges, first, step);
  // What is bright is told over minutes: colours that breathe cannot be read.
  sensor.brightest = intensities.reduce((most, one) => Math.max(most, one), Math.max(1, 0.9995 * (sensor.brightest ?? 1)));
  const byShade = Array.from({ length: intensities.length ? SHADES : 0 }, () => []);
  intensities.forEach((one, i) => {
    if (Number.isNaN(points[2 * i])) return;
    byShade[Math.min(SHADES - 1, Math.floor(SHADES * Math.sqrt(one / sensor.brightest)))].push(points[2 * i], points[2 * i + 1]);
  });
  sensor.frame = told.frame;
  isFitDue = true;
  sensor.scan = { ...told, points, byShade, at: performance.now() };
}

function takeForeground(topic, buffer, offset) {
  const sensor = sensorAt(topic);
  const now = performance.now();
  sensor.foreground = pointCloud(buffer, offset);
  if (now - sensor.trail.at(-1)?.at < TRAIL_STEP_MS) return;
  // Here, too: a page that nobody sees draws no frames.
  sensor.trail = sensor.trail.filter(({ at }) => now - at < TRAIL_MS);
  sensor.trail.push({ at: now, points: sensor.foreground });
}

/** What is always there is told as a scan that nobody measured. */
function takeBackground(topic, buffer, offset) {
  const { ranges, first, step } = laserScan(buffer, offset);
  sensorAt(topic).background = places(ranges, first, step);
}

/** x and y of each range in the frame of the sensor; not a number where there is none. */
function places(ranges, first, step) {
  const xy = new Float32Array(2 * ranges.length);
  for (let i = 0; i < ranges.length; i++) {
    const range = Number.isFinite(ranges[i]) ? ranges[i] : NaN;
    xy[2 * i] = range * Math.cos(first + i * step);
    xy[2 * i + 1] = range * Math.sin(first + i * step);
  }
  return xy;
}

/** Where a sensor sits; nothing as long as nobody told, and what it sees is nowhere. */
const poseOf = ({ frame, name }) => poses.get(frame ?? name);

const told = (entity) => Object.fromEntries(entity.metadata.map(({ key, value }) => [key, value]));

function takeZones(update) {
  circles = [];
  beams = [];
  for (const entity of update.entities) {
    const said = told(entity);
    if (entity.cylinders.length) circles.push({ radius: Number(said.radius_m), verdict: said.verdict });
    for (const line of entity.lines) beams.push({ points: line.points, verdict: said.verdict, ...said });
  }
}

function takeLines(update) {
  walls = update.entities.flatMap((entity) => entity.lines).flatMap(({ points }) =>
    points.flatMap((from, n) => (n % 2 ? [] : [[from, points[n + 1]]])));
  corners = update.entities.flatMap((entity) => entity.spheres.map((one) => one.pose.position));
}

function takeTracks(topic, update) {
  const persons = update.entities.map((entity) => {
    const [body, reach] = entity.cylinders;
    const { z, w } = reach.pose.orientation;
    return { ...told(entity), ...body.pose.position, across: body.size.x, tail: entity.lines[0].points,
      reach: { x: reach.size.x / 2, y: reach.size.y / 2, yaw: 2 * Math.atan2(z, w) } };
  });
  people.set(topic, { at: performance.now(), persons });
}

function takeStatus(topic, status) {
  const sensor = sensorAt(topic);
  const now = performance.now();
  sensor.status = status;
  sensor.name = status.name;
  sensor.history.push({ at: now, hz: status.hz ?? 0, damaged: status.lost_share ?? status.damaged, age: status.age_p99_ms ?? 0 });
  while (now - sensor.history[0].at > HISTORY_MS) sensor.history.shift();
  if (status.trouble) Object.assign(sensor, { scan: null, foreground: null, trail: [] });
}

/** Which topics make the picture, and not the words beside it. */
const PICTURE = /\/(scan|foreground|background|zones|marks|lines|tracks)$/;
let kept = null; // what came for the picture while it is held, the newest of each topic

function take(topic, buffer, offset) {
  if (kept && PICTURE.test(topic)) {
    kept.set(topic, [buffer, offset]);
    if (topic.endsWith("/scan")) sensorAt(topic).scans += 1;
    return;
  }
  show(topic, buffer, offset);
  if (topic.endsWith("/scan")) {
    const sensor = sensorAt(topic);
    sensor.scans += 1;
    sensor.stamp = Number(new DataView(buffer).getBigUint64(5, true)) / 1e6;
  }
  wake();
}

function show(topic, buffer, offset) {
  const object = () => JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, offset)));
  if (topic === "/robot") takeRobot(object());
  else if (topic === "/replay") player = object();
  else if (topic === "/tf_static") transforms(buffer, offset);
  else if (topic === "/zones") takeZones(object());
  else if (topic === "/marks") marks = object().entities.flatMap((entity) => entity.spheres.map((one) => one.pose.position));
  else if (topic === "/lines") takeLines(object());
  else if (topic.endsWith("/tracks")) takeTracks(topic, object());
  else if (topic.endsWith("/scan")) takeScan(topic, buffer, offset);
  else if (topic.endsWith("/foreground")) takeForeground(topic, buffer, offset);
  else if (topic.endsWith("/background")) takeBackground(topic, buffer, offset);
  else if (topic.endsWith("/status")) takeStatus(topic, object());
}

function takeRobot(said) {
  const was = robot.hub;
  robot = said;
  heard = performance.now();
  if (was && !said.hub) forget();
}

/** The hub is gone: what was seen is not there any more, except for the background. */
function forget() {
  for (const sensor of sensors.values()) Object.assign(sensor, { scan: null, foreground: null, trail: [] });
  circles = [];
  beams = [];
  marks = [];
  walls = [];
  corners = [];
  people.clear();
}

// ---------------------------------------------------------------- the socket

let socket = null;
let isOpen = false;
let retry = 250;
const topics = new Map(); // by channel, which is the number of its subscription, too

/** Whoever asks for lines costs the hub something: that is done while they are looked at. */
const isWanted = (topic) => topic !== "/lines" || layers.lines;

function subscribe(ids) {
  const wanted = ids.filter((id) => isWanted(topics.get(id)));
  socket.send(JSON.stringify({ op: "subscribe", subscriptions: wanted.map((id) => ({ id, channelId: id })) }));
}

function changeLines() {
  const [id] = [...topics].find(([, topic]) => topic === "/lines") ?? [];
  if (!isOpen || id === undefined) return;
  if (layers.lines) return subscribe([id]);
  socket.send(JSON.stringify({ op: "unsubscribe", subscriptionIds: [id] }));
  walls = [];
  corners = [];
}

function connect() {
  const scheme = location.protocol === "https:" ? "wss" : "ws";
  socket = new WebSocket(`${scheme}://${location.host}/${location.search}`, "foxglove.sdk.v1");
  socket.binaryType = "arraybuffer";
  topics.clear();
  socket.onopen = () => {
    isOpen = true;
    retry = 250;
  };
  socket.onmessage = ({ data }) => {
    if (typeof data !== "string") {
      const view = new DataView(data);
      const topic = view.getUint8(0) === 1 && topics.get(view.getUint32(1, true));
      if (topic) take(topic, data, 13);
      return;
    }
    const said = JSON.parse(data);
    if (said.op === "advertise") {
      for (const channel of said.channels) topics.set(channel.id, channel.topic);
      subscribe(said.channels.map(({ id }) => id));
    } else if (said.op === "status") {
      $("news").textContent = said.message;
      setTimeout(() => { if ($("news").textContent === said.message) $("news").textContent = ""; }, 4000);
    }
  };
  socket.onclose = () => {
    isOpen = false;
    setTimeout(connect, retry);
    retry = Math.min(2 * retry, 2000);
    wake();
  };
}

// ---------------------------------------------------------------- the view

/** What was chosen before in this window; browsers may refuse to keep anything. */
function stored(key, otherwise) {
  try {
    return JSON.parse(sessionStorage.getItem(key)) ?? otherwise;
  } catch {
    return otherwise;
  }
}

function store(key, value) {
  try {
    sessionStorage.setItem(key, JSON.stringify(value));
  } catch { /* It holds as long as the page is open. */ }
}

const layers = Object.assign({ scan: true, intensity: true, foreground: true, trails: true, background: true, zones: true,
  marks: true, lines: false, field: true, grid: true }, stored("layers", {}));
const view = { x: 1, y: 0, scale: 60, turn: 0, fits: true, isFitted: false, goal: null, only: null };
const isCalm = matchMedia("(prefers-reduced-motion: reduce)");
let pointer = null; // over the picture, in pixels
let tape = null; // { from, to } in metres
let isTape = false;
let size = { width: 1, height: 1, ratio: 1 };

/** The part of the window that nothing covers. */
function open() {
  const isNarrow = size.width <= 720;
  const right = isNarrow ? 0 : 320;
  const bottom = isNarrow ? 60 + ($("sensors").offsetHeight || 0) : player ? 116 : 60;
  const top = 56;
  return { x: (size.width - right) / 2, y: top + (size.height - top - bottom) / 2, width: size.width - right,
    height: size.height - top - bottom };
}

function toScreen(x, y) {
  const { x: cx, y: cy } = middle;
  const [a, b] = [-(y - view.y) * view.scale, -(x - view.x) * view.scale];
  return [cx + a * cos - b * sin, cy + a * sin + b * cos];
}

/** From a sensor's frame to the right and down in the turned picture, `scale` pixels a metre, from the robot's centre on: the six
 * numbers of a canvas's transformation. */
function turned([xx, xy, yx, yy, x, y], scale) {
  const [c, s] = [cos * scale, sin * scale];
  return [xx * s - yx * c, -xx * c - yx * s, xy * s - yy * c, -xy * c - yy * s, x * s - y * c, -x * c - y * s];
}

/** From a sensor's frame to the screen. */
function onScreen(pose) {
  const [a, b, c, d, e, f] = turned(pose, view.scale);
  const [x, y] = toScreen(0, 0);
  return [a, b, c, d, e + x, f + y];
}

function toRobot(px, py) {
  const [a, b] = [px - middle.x, py - middle.y];
  return [view.x - (-a * sin + b * cos) / view.scale, view.y - (a * cos + b * sin) / view.scale];
}

let middle = { x: 0, y: 0, width: 1, height: 1 };
let [cos, sin] = [1, 0];

function place() {
  middle = open();
  [cos, sin] = [Math.cos(view.turn), Math.sin(view.turn)];
}

const shown = () => [...sensors.values()].filter((sensor) => (view.only === null ? !sensor.status?.remote || !hasOwn() : sensor.space === view.only));
const hasOwn = () => [...sensors.values()].some((sensor) => sensor.status && !sensor.status.remote);

const MARGIN = 1.1;

/** Brings what is seen into the picture, few outliers left out; keeps what is about right. */
function fit() {
  const scans = shown().filter((sensor) => sensor.scan && poseOf(sensor));
  // Where a picture ends some hundred points tell as well as thousands.
  const stride = 2 * Math.ceil(scans.reduce((sum, { scan }) => sum + scan.points.length, 0) / 1000);
  const across = [];
  const along = [];
  for (const sensor of scans) {
    const { points } = sensor.scan;
    const [a, b, c, d, e, f] = turned(poseOf(sensor), 1);
    for (let i = 0; i < points.length; i += stride) {
      const [x, y] = [points[i], points[i + 1]];
      if (Number.isNaN(x)) continue;
      across.push(a * x + c * y + e);
      along.push(b * x + d * y + f);
    }
  }
  if (!across.length) return;
  const reach = Math.max(0.5, ...circles.map(({ radius }) => radius)) * 1.08;
  const span = (unsorted) => {
    const values = Float32Array.from(unsorted).sort();
    const out = Math.floor(values.length / 50);
    return [Math.min(values[out], -reach), Math.max(values[values.length - 1 - out], reach)];
  };
  const [left, right] = span(across);
  const [top, bottom] = span(along);
  const scale = Math.min(middle.width / (right - left), middle.height / (bottom - top)) / MARGIN;
  const [a, b] = [(left + right) / 2, (top + bottom) / 2];
  const goal = { scale, x: -(-a * sin + b * cos), y: -(a * cos + b * sin) };
  const now = view.goal ?? view;
  const moved = Math.hypot(goal.x - now.x, goal.y - now.y) * scale;
  // A picture that breathes cannot be read: as long as all is in it and not too small, it stays.
  const isOut = scale * MARGIN < now.scale * 0.99 || moved > 0.12 * Math.min(middle.width, middle.height);
  if (isOut || now.scale < 0.6 * scale || !view.isFitted) Object.assign(view, { goal, isFitted: true });
}

/** Moves towards where the picture is to be; true while it moves. */
function glide() {
  if (!view.goal) return false;
  const share = isCalm.matches ? 1 : 0.16;
  const { x, y, scale } = view.goal;
  view.x += (x - view.x) * share;
  view.y += (y - view.y) * share;
  view.scale *= (scale / view.scale) ** share;
  if (Math.abs(Math.log(scale / view.scale)) < 0.002 && Math.hypot(x - view.x, y - view.y) * scale < 0.5) {
    Object.assign(view, view.goal, { goal: null });
  }
  return true;
}

// ---------------------------------------------------------------- drawing

const colours = {};
let shadeColours = [];

function readColours() {
  const probe = document.createElement("span");
  document.body.append(probe);
  for (const name of ["paper", "ink", "soft", "grid", "axis", "accent", "clear", "slow", "stop", "new", "old", "mark", "line", "person", "shade", "edge"]) {
    probe.style.color = `var(--${name})`;
    colours[name] = getComputedStyle(probe).color;
  }
  colours.unknown = colours.stop;
  // Whether it is dark is told by the paper.
  const [red] = colours.paper.match(/[\d.]+/g).map(Number);
  const isDark = red < (colours.paper.includes("srgb") ? 0.5 : 128);
  probe.remove();
  const stops = isDark
    ? [[92, 124, 196], [70, 176, 214], [116, 214, 158], [250, 220, 96]]
    : [[52, 78, 148], [28, 120, 150], [24, 146, 98], [196, 120, 0]];
  shadeColours = Array.from({ length: SHADES }, (_, n) => {
    const at = (n / (SHADES - 1)) * (stops.length - 1);
    const [low, high] = [stops[Math.floor(at)], stops[Math.ceil(at)]];
    return `rgb(${low.map((value, i) => Math.round(value + (high[i] - value) * (at % 1))).join(" ")})`;
  });
}

const STEPS = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50];

/** Words with the paper around them, so that no line runs through. */
function label(text, x, y) {
  pen.lineWidth = 4;
  pen.lineJoin = "round";
  pen.strokeStyle = colours.paper;
  pen.strokeText(text, x, y);
  pen.fillText(text, x, y);
}

function drawGrid() {
  const step = STEPS.find((length) => length * view.scale >= 64) ?? 100;
  const reach = Math.hypot(size.width, size.height) / view.scale / 2 + step;
  const from = (centre) => Math.ceil((centre - reach) / step);
  const to = (centre) => Math.floor((centre + reach) / step);
  pen.lineWidth = 1;
  for (const [colour, isAxis] of [[colours.grid, false], [colours.axis, true]]) {
    pen.strokeStyle = colour;
    pen.beginPath();
    for (let n = from(view.x); n <= to(view.x); n++) {
      if ((n === 0) !== isAxis) continue;
      pen.moveTo(...toScreen(n * step, view.y - reach));
      pen.lineTo(...toScreen(n * step, view.y + reach));
    }
    for (let n = from(view.y); n <= to(view.y); n++) {
      if ((n === 0) !== isAxis) continue;
      pen.moveTo(...toScreen(view.x - reach, n * step));
      pen.lineTo(...toScreen(view.x + reach, n * step));
    }
    pen.stroke();
  }
  pen.fillStyle = colours.soft;
  pen.font = "11px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  const digits = step < 0.1 ? 2 : step < 1 ? 1 : 0;
  const free = ([x, y]) => x > 20 && x < middle.x + middle.width / 2 - 20 && y > 64 && y < middle.y + middle.height / 2 - 8;
  // Where a circle crosses the axis stands what that is.
  const isBare = (n) => n !== 0 && !(layers.zones && circles.some(({ radius }) => Math.abs(Math.abs(n * step) - radius) * view.scale < 26));
  for (let n = from(view.x); n <= to(view.x); n++) {
    const [x, y] = toScreen(n * step, 0);
    if (isBare(n) && free([x, y])) label((n * step).toFixed(digits), x + 13 * cos, y + 13 * sin);
  }
  for (let n = from(view.y); n <= to(view.y); n++) {
    const [x, y] = toScreen(0, n * step);
    if (isBare(n) && free([x, y])) label((n * step).toFixed(digits), x - 11 * sin, y + 11 * cos);
  }
}

function drawRobot() {
  const [x, y] = toScreen(0, 0);
  pen.fillStyle = colours.ink;
  pen.beginPath();
  for (const [ahead, left] of [[11, 0], [-7, 7], [-3.5, 0], [-7, -7]]) {
    const [a, b] = [-left, -ahead];
    pen.lineTo(x + a * cos - b * sin, y + a * sin + b * cos);
  }
  pen.fill();
}

function drawField(sensor) {
  const { scan } = sensor;
  const pose = poseOf(sensor);
  if (!scan || !pose) return;
  const far = Math.min(scan.farthest, 2 * Math.hypot(size.width, size.height) / view.scale);
  const at = (angle) => {
    const [x, y] = [far * Math.cos(angle), far * Math.sin(angle)];
    return toScreen(pose[0] * x + pose[1] * y + pose[4], pose[2] * x + pose[3] * y + pose[5]);
  };
  pen.beginPath();
  const isTurn = scan.last - scan.first > 6.2;
  if (!isTurn) pen.moveTo(...toScreen(pose[4], pose[5]));
  for (let n = 0; n <= 60; n++) pen.lineTo(...at(scan.first + ((scan.last - scan.first) * n) / 60));
  pen.closePath();
  pen.fillStyle = colours.shade;
  pen.fill();
  if (!isTurn) {
    pen.strokeStyle = colours.axis;
    pen.setLineDash([1, 5]);
    pen.beginPath();
    for (const angle of [scan.first, scan.last]) {
      pen.moveTo(...toScreen(pose[4], pose[5]));
      pen.lineTo(...at(angle));
    }
    pen.stroke();
    pen.setLineDash([]);
  }
}

const HIDDEN = 0.8; // pixels

/** Squares of `width` at `points` of a sensor at `pose`; how many of them are numbers. */
function dots(points, width, pose) {
  if (!points || !pose) return 0;
  const [a, b, c, d, e, f] = onScreen(pose);
  const [left, top] = [e - width / 2, f - width / 2];
  let [count, px, py] = [0, NaN, NaN];
  for (let i = 0; i < points.length; i += 2) {
    const x = left + a * points[i] + c * points[i + 1];
    const y = top + b * points[i] + d * points[i + 1];
    if (x !== x) continue;
    count += 1;
    // What is hidden behind the one before costs as much as what is seen.
    if (Math.abs(x - px) < HIDDEN && Math.abs(y - py) < HIDDEN) continue;
    pen.fillRect(x, y, width, width);
    [px, py] = [x, y];
  }
  return count;
}

function drawScan(sensor) {
  const { scan } = sensor;
  if (!scan) return 0;
  const pose = poseOf(sensor);
  const width = scan.points.length > 2000 ? 2.5 : 3.5;
  if (!layers.intensity || !scan.byShade.length) {
    pen.fillStyle = colours.ink;
    return dots(scan.points, width, pose);
  }
  // A colour is set once for all that have it.
  let count = 0;
  scan.byShade.forEach((points, shade) => {
    pen.fillStyle = shadeColours[shade];
    count += dots(points, width, pose);
  });
  return count;
}

function drawTrail(sensor, now) {
  pen.fillStyle = colours.new;
  for (const { at, points } of sensor.trail) {
    pen.globalAlpha = 0.34 * Math.max(0, 1 - (now - at) / TRAIL_MS);
    dots(points, 3, poseOf(sensor));
  }
  pen.globalAlpha = 1;
}

function drawZones() {
  pen.textAlign = "center";
  pen.textBaseline = "bottom";
  pen.font = "600 12px system-ui, sans-serif";
  const [x, y] = toScreen(0, 0);
  for (const { radius, verdict } of circles) {
    const isViolated = verdict !== "clear";
    pen.beginPath();
    pen.arc(x, y, radius * view.scale, 0, 2 * Math.PI);
    pen.strokeStyle = pen.fillStyle = colours[verdict];
    if (isViolated) {
      pen.globalAlpha = 0.09;
      pen.fill();
      pen.globalAlpha = 1;
    }
    pen.lineWidth = isViolated ? 2.5 : 1.5;
    pen.setLineDash(isViolated ? [] : [6, 5]);
    pen.stroke();
    pen.setLineDash([]);
    const up = y - radius * view.scale - 4;
    label(`${radius.toFixed(2)} m${isViolated ? " !" : ""}`, x, up);
  }
  for (const { points: [from, to], verdict } of beams) {
    pen.strokeStyle = pen.fillStyle = colours[verdict];
    pen.lineWidth = 2;
    pen.beginPath();
    pen.moveTo(...toScreen(from.x, from.y));
    pen.lineTo(...toScreen(to.x, to.y));
    pen.stroke();
    pen.beginPath();
    pen.arc(...toScreen(to.x, to.y), 5.5, 0, 2 * Math.PI);
    pen.stroke();
  }
  return circles.length;
}

function drawMarks() {
  pen.fillStyle = colours.mark;
  pen.strokeStyle = colours.paper;
  pen.lineWidth = 1.5;
  for (const mark of marks) {
    const [x, y] = toScreen(mark.x, mark.y);
    pen.beginPath();
    for (const [a, b] of [[0, -8], [7, 0], [0, 8], [-7, 0]]) pen.lineTo(x + a, y + b);
    pen.closePath();
    pen.fill();
    pen.stroke();
  }
  return marks.length;
}

function drawLines() {
  pen.strokeStyle = pen.fillStyle = colours.line;
  pen.lineWidth = 2;
  pen.beginPath();
  for (const [from, to] of walls) {
    pen.moveTo(...toScreen(from.x, from.y));
    pen.lineTo(...toScreen(to.x, to.y));
  }
  pen.stroke();
  for (const corner of corners) {
    const [x, y] = toScreen(corner.x, corner.y);
    pen.strokeRect(x - 4.5, y - 4.5, 9, 9);
  }
  return walls.length;
}

/** Each with number and tail, and where else they may be; who is not seen is dashed and pale. */
function drawPeople() {
  pen.strokeStyle = pen.fillStyle = colours.person;
  pen.lineWidth = 2;
  pen.font = "600 13px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "bottom";
  const all = persons();
  for (const { id, state, x, y, across, tail, reach } of all) {
    const [px, py] = toScreen(x, y);
    const radius = Math.max(7, (across / 2) * view.scale);
    pen.globalAlpha = 0.15;
    pen.beginPath();
    pen.ellipse(px, py, reach.x * view.scale, reach.y * view.scale, Math.PI / 2 - reach.yaw + view.turn, 0, 2 * Math.PI);
    pen.fill();
    pen.globalAlpha = state === "confirmed" ? 1 : 0.5;
    if (layers.trails) {
      pen.beginPath();
      for (const at of tail) pen.lineTo(...toScreen(at.x, at.y));
      pen.stroke();
    }
    if (state !== "confirmed") pen.setLineDash([4, 4]);
    pen.beginPath();
    pen.arc(px, py, radius, 0, 2 * Math.PI);
    pen.stroke();
    pen.setLineDash([]);
    label(`#${id}`, px, py - radius - 3);
    pen.lineWidth = 2;
  }
  pen.globalAlpha = 1;
  return all.length;
}

function drawTape() {
  if (!tape) return;
  const [from, to] = [toScreen(...tape.from), toScreen(...tape.to)];
  pen.strokeStyle = pen.fillStyle = colours.accent;
  pen.lineWidth = 2;
  pen.beginPath();
  pen.moveTo(...from);
  pen.lineTo(...to);
  pen.stroke();
  for (const [x, y] of [from, to]) {
    pen.beginPath();
    pen.arc(x, y, 4, 0, 2 * Math.PI);
    pen.fill();
  }
  const metres = Math.hypot(tape.to[0] - tape.from[0], tape.to[1] - tape.from[1]);
  pen.font = "600 14px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "bottom";
  label(`${metres.toFixed(3)} m`, (from[0] + to[0]) / 2, (from[1] + to[1]) / 2 - 8);
}

function drawSensors() {
  pen.font = "600 11px system-ui, sans-serif";
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  const seen = shown();
  [...sensors.values()].forEach((sensor, n) => {
    const pose = poseOf(sensor);
    if (!pose || !seen.includes(sensor)) return;
    const [x, y] = toScreen(pose[4], pose[5]);
    pen.beginPath();
    pen.arc(x, y, 8.5, 0, 2 * Math.PI);
    pen.fillStyle = colours.paper;
    pen.fill();
    pen.lineWidth = 1.5;
    pen.strokeStyle = colours.ink;
    pen.stroke();
    pen.fillStyle = colours.ink;
    pen.fillText(String(n + 1), x, y + 0.5);
  });
}

function draw(now) {
  place();
  if (view.fits && isFitDue && !kept) fit();
  isFitDue = false;
  const moves = glide();
  pen.setTransform(size.ratio, 0, 0, size.ratio, 0, 0);
  pen.fillStyle = colours.paper;
  pen.fillRect(0, 0, size.width, size.height);
  Object.assign(drawn, { beams: 0, foreground: 0, zones: 0, marks: 0, lines: 0, tracks: 0 });
  const seen = shown();
  if (layers.field) seen.forEach(drawField);
  if (layers.grid) drawGrid();
  if (layers.background) {
    pen.fillStyle = colours.old;
    for (const sensor of seen) dots(sensor.background, 2.5, poseOf(sensor));
  }
  if (layers.trails) for (const sensor of seen) drawTrail(sensor, now);
  if (layers.zones) drawn.zones = drawZones();
  if (layers.scan) for (const sensor of seen) drawn.beams += drawScan(sensor);
  if (layers.foreground) {
    pen.fillStyle = colours.new;
    for (const sensor of seen) drawn.foreground += dots(sensor.foreground, 5, poseOf(sensor));
  }
  if (layers.lines) drawn.lines = drawLines();
  if (layers.marks) drawn.marks = drawMarks();
  drawn.tracks = drawPeople();
  if (!robot.map) drawRobot();
  drawSensors();
  drawTape();
  readOut();
  tellVerdict();
  frames += 1;
  for (const sensor of seen) {
    if (sensor.stamp) ages.push([sensor.stamp, performance.timeOrigin + performance.now()]);
    sensor.stamp = null;
  }
  ages.splice(0, ages.length - 400);
  return moves;
}

// ---------------------------------------------------------------- frames

let isAwake = false;
let isFitDue = false; // something came, or the view is another one

function wake() {
  if (isAwake) return;
  isAwake = true;
  requestAnimationFrame((now) => {
    isAwake = false;
    let goesOn = draw(now);
    for (const sensor of sensors.values()) {
      sensor.trail = sensor.trail.filter(({ at }) => now - at < TRAIL_MS);
      goesOn ||= sensor.trail.length > 0;
    }
    if (goesOn) wake();
  });
}

function resize() {
  view.isFitted = false;
  isFitDue = true;
  size = { width: innerWidth, height: innerHeight, ratio: Math.min(devicePixelRatio || 1, 3) };
  map.width = Math.round(size.width * size.ratio);
  map.height = Math.round(size.height * size.ratio);
  wake();
}

// ---------------------------------------------------------------- words

/** So many digits behind the point; what rounds to nothing has no sign. */
const fixed = (value, digits) => value.toFixed(digits).replace(/^-(?=[0.]*$)/, "");

/** What is under the pointer: a point of a scan, or a place. */
function readOut() {
  const box = $("readout");
  if (!pointer || tape) return box.replaceChildren();
  let best = { apart: 14 };
  for (const sensor of shown()) {
    const points = layers.scan && sensor.scan?.points;
    const pose = poseOf(sensor);
    if (!points || !pose) continue;
    const [a, b, c, d, e, f] = onScreen(pose);
    for (let i = 0; i < points.length; i += 2) {
      const x = a * points[i] + c * points[i + 1] + e;
      const y = b * points[i] + d * points[i + 1] + f;
      const apart = Math.hypot(x - pointer[0], y - pointer[1]);
      if (apart < best.apart) best = { apart, sensor, beam: i / 2, at: toRobot(x, y), screen: [x, y] };
    }
  }
  const [x, y] = best.at ?? toRobot(...pointer);
  const bold = document.createElement("b");
  bold.textContent = `${fixed(Math.hypot(x, y), 2)} m from the ${robot.map ? "map's origin" : "robot"}`;
  const lines = [bold, `\nx ${fixed(x, 2)}  y ${fixed(y, 2)} m`];
  if (best.sensor) {
    const { scan, name } = best.sensor;
    const angle = ((scan.first + best.beam * scan.step) * 180) / Math.PI;
    lines.push(`\n${name}: ${fixed(angle, 2)}\u00b0, ${fixed(scan.ranges[best.beam], 3)} m`);
    if (scan.byShade.length) lines.push(`, intensity ${scan.intensities[best.beam]}`);
  }
  box.replaceChildren(...lines);
  if (!best.sensor) return;
  pen.strokeStyle = colours.accent;
  pen.lineWidth = 2;
  pen.beginPath();
  pen.arc(...best.screen, 7, 0, 2 * Math.PI);
  pen.stroke();
}

const persons = () => [...people.values()].flatMap((one) => one.persons);

/** How many people are in which room. */
function tellPeople() {
  const rooms = new Map();
  const all = persons();
  for (const { room } of all) rooms.set(room, (rooms.get(room) ?? 0) + 1);
  // Who is in none comes last.
  const names = [...rooms.keys()].sort((a, b) => (!a - !b) || (a < b ? -1 : 1));
  const words = names.map((room) => `${room || "elsewhere"} ${rooms.get(room)}`).join(", ");
  put($("people"), words && `${all.length} ${all.length === 1 ? "person" : "people"}: ${words}`);
}

/** What a player shows while it waits stands. */
const stands = () => player !== null && (player.paused || player.over);
const isHeard = () => isOpen && performance.now() - heard < SILENT_MS;
const verdict = () => (isHeard() ? robot.verdict : "unknown");

function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** The verdict in words; with each frame, so that words and circles are of one moment. */
function tellVerdict() {
  const word = verdict();
  const box = $("verdict");
  if (box.className !== word) box.className = word;
  put(box.firstElementChild, word.toUpperCase());
  const nearest = isHeard() && robot.nearest_m !== null ? `nearest ${robot.nearest_m.toFixed(2)} m` : "";
  put(box.lastElementChild, [isHeard() ? robot.sensor : null, nearest].filter(Boolean).join(", ") + (kept ? "  ·  picture held" : ""));
  const load = robot.load_percent === null || robot.load_percent === undefined ? "" : `, ${robot.load_percent.toFixed(1)} % of a processor`;
  put($("hub"), !isHeard() ? "" : robot.hub ? `${robot.domain}: hub ${robot.pid ?? ""}${load}` : "no hub");
  const title = `${word.toUpperCase()} – scanhub`;
  if (document.title !== title) document.title = title;
}

function tell() {
  const now = performance.now();
  tellVerdict();
  for (const sensor of sensors.values()) {
    if (sensor.scan && !kept && !stands() && now - sensor.scan.at > Math.max(OLD_MS, 3000 * sensor.scan.period)) {
      Object.assign(sensor, { scan: null, foreground: null, trail: [] });
      wake();
    }
  }
  if (!isHeard()) {
    if (circles.length || [...sensors.values()].some(({ scan }) => scan)) {
      forget();
      wake();
    }
  }
  for (const [topic, { at }] of people) {
    if (!kept && !stands() && now - at > OLD_MS) {
      people.delete(topic);
      wake();
    }
  }
  tellPeople();
  tellPlayer();
  explain();
}

function clock(seconds) {
  const [minutes, rest] = [Math.floor(seconds / 60), seconds % 60];
  return `${minutes}:${rest.toFixed(1).padStart(4, "0")}`;
}

/** How far the recording is, where one is played. */
function tellPlayer() {
  const box = $("player");
  box.hidden = !player;
  if (!player) return;
  const { position_s: at, length_s: length, rate, paused, over, lap } = player;
  const state = over ? "at its end" : paused ? "paused" : `\u00d7${rate ?? "max"}`;
  const speed = over || !paused ? "" : `, \u00d7${rate ?? "max"}`;
  put($("played"), [clock(at), length === null ? "" : ` / ${clock(length)}`, `  ${state}${speed}`, lap ? `  lap ${lap + 1}` : ""].join(""));
  $("line").hidden = length === null;
  $("line").max = length ?? 1;
  $("line").value = at;
  const button = box.querySelector("[data-order=toggle]");
  put(button, paused ? "Play" : "Pause");
  for (const one of box.querySelectorAll("button")) one.disabled = over || !isOpen;
}

/** Why the picture is empty, and what to do. */
function explain() {
  let trouble = null;
  if (!isOpen) trouble = { what: "No connection to scanhub web", remedy: "It ended, or the network between is cut. This page tries again by itself." };
  else if (!isHeard()) trouble = { what: "scanhub web is silent", remedy: "It does not say anything any more: look at the terminal where it runs." };
  else if (robot.trouble) trouble = robot.trouble;
  else if (!robot.hub) trouble = { what: "No hub", remedy: "scanhub run" };
  else if (shown().length && shown().every(({ scan }) => !scan)) {
    const [first] = shown();
    const told = first.status?.trouble;
    if (told) trouble = { what: `${first.name}: ${told.what}`, remedy: told.remedy };
  }
  const box = $("reason");
  box.hidden = !trouble;
  if (trouble) {
    put(box.firstElementChild, trouble.what);
    put(box.lastElementChild, trouble.remedy);
  }
}

const FIELDS = [
  ["rate", "hz", ({ hz }) => (hz === null ? "–" : `${hz.toFixed(1)} Hz`)],
  ["age p50 / p99", "age", ({ age_p50_ms: half, age_p99_ms: most }) => (half === null ? "–" : `${half.toFixed(1)} / ${most.toFixed(1)} ms`)],
  ["damaged on the line", "damaged", ({ lost_share: lost, damaged }) => percent(Math.max(lost ?? 0, damaged))],
  ["lost line / here", null, ({ lost_on_line: line, lost }) => `${line ?? "–"} / ${lost}`],
];
const percent = (share) => `${(100 * share).toFixed(share > 0 && share < 0.1 ? 2 : share === 0 ? 0 : 1)} %`;
const WELL = 0.001;

function makeCard(sensor) {
  const card = document.createElement("article");
  const make = (tag, parent, name) => {
    const element = document.createElement(tag);
    if (name) element.className = name;
    parent.append(element);
    return element;
  };
  const title = make("h2", card);
  sensor.card = { card, title: make("button", title), state: make("i", title), kind: make("div", card, "kind"), trouble: make("p", card, "trouble"), fields: [] };
  const list = make("dl", card);
  for (const [label, series, text] of FIELDS) {
    const field = make("div", list);
    make("dt", field).textContent = label;
    const value = make("dd", field);
    const number = make("span", value);
    const line = series && make("canvas", value);
    if (line) line.setAttribute("aria-hidden", "true");
    sensor.card.fields.push({ field, number, line, series, text });
  }
  sensor.card.title.onclick = () => choose(sensor.space);
  $("sensors").append(card);
}

function tellSensors() {
  [...sensors.values()].forEach((sensor, n) => {
    const { status } = sensor;
    if (!status) return;
    if (!sensor.card) makeCard(sensor);
    const { card, title, state, kind, trouble, fields } = sensor.card;
    const loss = Math.max(status.lost_share ?? 0, status.damaged);
    const isHere = isHeard() && robot.hub;
    const word = isHere ? status.state : "unheard";
    card.className = [word, loss > WELL ? "lossy" : "", shown().includes(sensor) ? "" : "off"].join(" ");
    put(title, `${n + 1}  ${sensor.name}`);
    title.setAttribute("aria-pressed", String(view.only === sensor.space));
    put(state, word + (status.frozen ? ", frozen" : ""));
    put(kind, [status.family, status.model, status.port].filter(Boolean).join(" · "));
    const told = isHere && status.trouble;
    const lossWords = loss > WELL && isHere ? `${percent(loss)} of its line is damaged or lost: check cable, ground and rate` : "";
    put(trouble, told ? [told.what, told.remedy].filter(Boolean).join(": ") : lossWords);
    for (const { field, number, line, series, text } of fields) {
      put(number, isHere ? text(status) : "–");
      field.className = series === "damaged" && loss > WELL ? "amber" : "";
      if (line) sparkline(line, sensor.history, series);
    }
  });
}

/** The last two minutes; the middle of a bare line is no trouble, so it begins at 0. */
function sparkline(canvas, history, series) {
  const width = canvas.clientWidth;
  const height = canvas.clientHeight;
  const ratio = size.ratio;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const line = canvas.getContext("2d");
  line.scale(ratio, ratio);
  const now = performance.now();
  let most = series === "damaged" ? 0.01 : 1;
  for (const one of history) most = Math.max(most, one[series]);
  line.strokeStyle = colours.edge;
  line.beginPath();
  line.moveTo(0, height - 0.5);
  line.lineTo(width, height - 0.5);
  line.stroke();
  line.strokeStyle = series === "damaged" ? colours.slow : colours.accent;
  line.lineWidth = 1.5;
  line.lineJoin = "round";
  line.beginPath();
  for (const one of history) {
    line.lineTo(width - ((now - one.at) / HISTORY_MS) * width, height - 1 - (one[series] / (most * 1.15)) * (height - 3));
  }
  line.stroke();
}

// ---------------------------------------------------------------- what a person does

function choose(space) {
  view.only = space === view.only ? null : space;
  isFitDue = true;
  wake();
  tellSensors();
}

function zoom(factor, px = middle.x, py = middle.y) {
  const [x, y] = toRobot(px, py);
  leaveFit();
  view.scale = Math.min(4000, Math.max(1.5, view.scale * factor));
  const [nx, ny] = toRobot(px, py);
  view.x += x - nx;
  view.y += y - ny;
  wake();
}

function pan(dx, dy) {
  const [x, y] = toRobot(middle.x - dx, middle.y - dy);
  leaveFit();
  [view.x, view.y] = [Math.max(-200, Math.min(200, x)), Math.max(-200, Math.min(200, y))];
  wake();
}

function turn(angle) {
  view.turn += angle;
  isFitDue = true;
  place();
  wake();
}

function leaveFit() {
  Object.assign(view, { fits: false, goal: null });
  press("fit", false);
}

function press(name, isOn) {
  document.querySelector(`nav [data-do="${name}"]`).setAttribute("aria-pressed", String(isOn));
}

const actions = {
  fit: () => {
    Object.assign(view, { fits: true, isFitted: false, turn: 0 });
    place();
    press("fit", true);
    fit();
  },
  in: () => zoom(1.25),
  out: () => zoom(0.8),
  turn: () => turn(Math.PI / 12),
  tape: () => {
    isTape = !isTape;
    tape = null;
    press("tape", isTape);
  },
  hold: () => {
    const waiting = kept;
    kept = waiting ? null : new Map();
    for (const [topic, [buffer, offset]] of waiting ?? []) show(topic, buffer, offset);
    press("hold", Boolean(kept));
    tell();
  },
  layers: () => press("layers", $("layers").classList.toggle("open")),
  theme: () => {
    const isDark = getComputedStyle(document.documentElement).colorScheme === "dark" || (!document.documentElement.dataset.theme && matchMedia("(prefers-color-scheme: dark)").matches);
    document.documentElement.dataset.theme = isDark ? "light" : "dark";
    readColours();
  },
  help: () => ($("help").open ? $("help").close() : $("help").showModal()),
};

function act(name) {
  actions[name]();
  wake();
}

for (const button of document.querySelectorAll("nav button")) button.onclick = () => act(button.dataset.do);
for (const button of document.querySelectorAll("#layers button")) {
  const { layer } = button.dataset;
  const mark = () => button.setAttribute("aria-pressed", String(layers[layer]));
  button.onclick = () => {
    layers[layer] = !layers[layer];
    store("layers", layers);
    if (layer === "lines") changeLines();
    mark();
    wake();
  };
  mark();
}

for (const button of document.querySelectorAll("#player button")) {
  button.onclick = () => {
    if (isOpen) socket.send(JSON.stringify({ op: "scanhub.player", order: button.dataset.order }));
  };
}

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || $("help").open) return;
  const isButton = event.target.tagName === "BUTTON";
  if (isButton && (event.key === " " || event.key === "Enter")) return;
  const step = 48;
  const moves = { ArrowLeft: [step, 0], ArrowRight: [-step, 0], ArrowUp: [0, step], ArrowDown: [0, -step] };
  if (moves[event.key]) pan(...moves[event.key]);
  else if (event.key === "=") act("in");
  else if (event.key === "[") turn(-Math.PI / 12);
  else if (event.key === "0") choose(view.only);
  else if (/^[1-9]$/.test(event.key)) {
    const sensor = [...sensors.values()][Number(event.key) - 1];
    if (sensor) choose(sensor.space);
  } else {
    const button = [...document.querySelectorAll("[data-key]")].find((one) => one.dataset.key === event.key);
    if (!button || button.closest("[hidden]")) return;
    button.click();
  }
  event.preventDefault();
});

// Fingers and the mouse: one moves, two zoom and turn.
const fingers = new Map();

map.addEventListener("pointerdown", (event) => {
  map.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, [event.clientX, event.clientY]);
  tape = null;
  if (isTape || event.shiftKey) {
    const at = toRobot(event.clientX, event.clientY);
    if (fingers.size === 1) tape = { from: at, to: at };
  }
  wake();
});

map.addEventListener("pointermove", (event) => {
  pointer = [event.clientX, event.clientY];
  const was = fingers.get(event.pointerId);
  if (was) {
    const [dx, dy] = [event.clientX - was[0], event.clientY - was[1]];
    const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
    if (tape && fingers.size === 1) tape.to = toRobot(event.clientX, event.clientY);
    else if (other) {
      const before = [was[0] - other[0], was[1] - other[1]];
      const after = [event.clientX - other[0], event.clientY - other[1]];
      turn(Math.atan2(after[1], after[0]) - Math.atan2(before[1], before[0]));
      zoom(Math.hypot(...after) / Math.max(1, Math.hypot(...before)), ...other);
    } else if (event.altKey) turn(dx / 200);
    else pan(dx, dy);
    fingers.set(event.pointerId, pointer);
  }
  wake();
});

const lift = (event) => {
  fingers.delete(event.pointerId);
  if (event.pointerType === "touch" && !fingers.size) pointer = [event.clientX, event.clientY];
};
map.addEventListener("pointerup", lift);
map.addEventListener("pointercancel", lift);
map.addEventListener("pointerleave", () => {
  pointer = null;
  wake();
});
map.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.0015)), event.clientX, event.clientY);
}, { passive: false });

addEventListener("resize", resize);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  readColours();
  wake();
});

// ---------------------------------------------------------------- numbers for whoever looks

/** x and y of each beam in the robot's frame. */
function pointsOf(sensor) {
  const pose = sensor && poseOf(sensor);
  if (!pose || !sensor.scan) return [];
  const [xx, xy, yx, yy, x, y] = pose;
  return [...sensor.scan.points].map((_, i, xs) => (i % 2 ? yx * xs[i - 1] + yy * xs[i] + y : xx * xs[i] + xy * xs[i + 1] + x));
}

Object.defineProperty(window, "scanhub", {
  get: () => ({
    frames,
    scans: Object.fromEntries([...sensors.values()].map(({ name, scans }) => [name, scans])),
    ...drawn,
    drawn_ms: [0.5, 0.99].map((share) => ages.map(([from, to]) => to - from).sort((a, b) => a - b)[Math.floor(share * (ages.length - 1))] ?? null),
    people: persons(),
    shown: () => ages,
    points: (name) => pointsOf([...sensors.values()].find((one) => one.name === name)),
    screen: toScreen,
    place: toRobot,
    view: { x: view.x, y: view.y, scale: view.scale, turn: view.turn },
    verdict: verdict(),
    connected: isOpen,
    player,
    reason: $("reason").hidden ? null : $("reason").innerText,
    sensors: [...sensors.values()].filter(({ status }) => status).map(({ name, status }) => ({
      name, state: status.state, hz: status.hz, lost: status.lost, damaged: status.damaged,
      age_p50_ms: status.age_p50_ms, age_p99_ms: status.age_p99_ms,
    })),
  }),
});

readColours();
resize();
connect();
tell();
setInterval(tell, 100);
setInterval(tellSensors, 500);
