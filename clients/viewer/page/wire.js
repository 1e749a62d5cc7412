// Messages of the server, and the WebSocket.

/** Reader of little-endian CDR: a header of four bytes, and then values, each at a multiple of its size. */
class Cdr {
  constructor(buffer, offset) {
    this.view = new DataView(buffer, offset + 4);
    this.at = 0;
  }
  #next(size) {
    this.at = ceil(this.at / size) * size;
    this.at += size;
    return this.at - size;
  }
  u8() { return this.view.getUint8(this.#next(1)); }
  u32() { return this.view.getUint32(this.#next(4), true); }
  f32() { return this.view.getFloat32(this.#next(4), true); }
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
  head() {
    this.u32();
    this.u32();
    this.text();
  }
}

function laserScan(buffer, offset) {
  const cdr = new Cdr(buffer, offset);
  cdr.head();
  const [first, last, step, , period, , farthest] = Array.from({ length: 7 }, () => cdr.f32());
  return { first, last, step, period, farthest, ranges: cdr.floats(), intensities: cdr.floats() };
}

/** Returns the number of points of a cloud, and functions that read a field of a point as a float or a byte. */
function pointCloud(buffer, offset) {
  const cdr = new Cdr(buffer, offset);
  cdr.head();
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
  const { view, at } = cdr;
  const offsetOf = (i, field) => at + i * step + fields[field];
  return { count, f32: (i, field) => view.getFloat32(offsetOf(i, field), true), u8: (i, field) => view.getUint8(offsetOf(i, field)) };
}

const SHADES = 24;

function takeScan(topic, buffer, offset) {
  const sensor = sensorAt(topic);
  const message = laserScan(buffer, offset);
  const { ranges, intensities, first, step } = message;
  const points = toPoints(ranges, first, step);
  // The highest intensity fades over minutes, because colors that change quickly cannot be read.
  sensor.brightest = intensities.reduce((highest, one) => max(highest, one), max(1, 0.9995 * (sensor.brightest ?? 1)));
  const byShade = Array.from({ length: intensities.length ? SHADES : 0 }, () => []);
  intensities.forEach((one, i) => {
    if (Number.isNaN(points[2 * i])) return;
    byShade[min(SHADES - 1, floor(SHADES * Math.sqrt(one / sensor.brightest)))].push(points[2 * i], points[2 * i + 1]);
  });
  isFitDue = true;
  sensor.scan = { ...message, points, byShade, at: performance.now() };
}

function takeForeground(topic, buffer, offset) {
  const sensor = sensorAt(topic);
  const now = performance.now();
  const { count, f32 } = pointCloud(buffer, offset);
  sensor.foreground = Float32Array.from({ length: 2 * count }, (_, n) => f32(n >> 1, n % 2 ? "y" : "x"));
  if (now - sensor.trail.at(-1)?.at < TRAIL_STEP_MS) return;
  // Frames drop old steps too, but a hidden page draws no frames.
  sensor.trail = sensor.trail.filter(({ at }) => now - at < TRAIL_MS);
  sensor.trail.push({ at: now, points: sensor.foreground });
}

/** Takes the background, which is sent as a scan. */
function takeBackground(topic, buffer, offset) {
  const { ranges, first, step } = laserScan(buffer, offset);
  sensorAt(topic).background = toPoints(ranges, first, step);
}

/** Returns x and y of each range in the sensor's frame; NaN for a beam without a reading. */
function toPoints(ranges, first, step) {
  const xy = new Float32Array(2 * ranges.length);
  for (let i = 0; i < ranges.length; i++) {
    const range = Number.isFinite(ranges[i]) ? ranges[i] : NaN;
    xy[2 * i] = range * Math.cos(first + i * step);
    xy[2 * i + 1] = range * Math.sin(first + i * step);
  }
  return xy;
}

/** Returns the pose of a sensor as a transform [xx, xy, yx, yy, x, y], which mirrors if the sensor is upside down.
 * Returns null while the pose is unknown; the sensor's data is then not drawn. */
function poseOf({ status }) {
  if (!status?.pose) return null;
  const { x_m, y_m, yaw_rad, upside_down } = status.pose;
  const [c, s, sign] = [Math.cos(yaw_rad), Math.sin(yaw_rad), upside_down ? -1 : 1];
  return [c, -s * sign, s, c * sign, x_m, y_m];
}

const metadataOf = (entity) => Object.fromEntries(entity.metadata.map(({ key, value }) => [key, value]));

function takeZones(update) {
  circles = [];
  beams = [];
  for (const entity of update.entities) {
    const metadata = metadataOf(entity);
    if (entity.cylinders.length) circles.push({ radius: Number(metadata.radius_m), verdict: metadata.verdict });
    for (const line of entity.lines) beams.push({ points: line.points, ...metadata });
  }
}

const spheres = (update) => update.entities.flatMap((entity) => entity.spheres.map((one) => one.pose.position));

function takeLines(update) {
  walls = update.entities.flatMap((entity) => entity.lines).flatMap(({ points }) =>
    points.flatMap((from, n) => (n % 2 ? [] : [[from, points[n + 1]]])));
  corners = spheres(update);
}

function takeTracks(update, topic) {
  const tracks = update.entities.map((entity) => {
    const [body, reach] = entity.cylinders;
    const { z, w } = reach.pose.orientation;
    return { ...metadataOf(entity), ...body.pose.position, across: body.size.x, tail: entity.lines[0].points,
      reach: { x: reach.size.x / 2, y: reach.size.y / 2, yaw: 2 * atan2(z, w) } };
  });
  people.set(topic, { at: performance.now(), tracks });
}

function takeStatus(status, topic) {
  const sensor = sensorAt(topic);
  const now = performance.now();
  const loss = max(status.lost_share ?? 0, status.damaged);
  sensor.status = { ...status, loss };
  sensor.name = status.name;
  sensor.history.push({ at: now, hz: status.hz ?? 0, loss, age: status.age_p99_ms ?? 0 });
  while (now - sensor.history[0].at > HISTORY_MS) sensor.history.shift();
  if (status.problem && !heldMessages) Object.assign(sensor, emptySensor());
  isFitDue = true;
}

function takeRobot(message) {
  const hadHub = robot.hub;
  robot = message;
  lastRobotAt = performance.now();
  if (hadHub && !message.hub) clearPicture();
}

/** Handlers of ROS messages, and of JSON objects, by the last word of the topic. */
const rosHandlers = { scan: takeScan, foreground: takeForeground, background: takeBackground, cloud: takeCloud };
const jsonHandlers = { robot: takeRobot, status: takeStatus, zones: takeZones, lines: takeLines, tracks: takeTracks, obstacles: takeObstacles,
  marks: (update) => { marks = spheres(update); }, replay: (progress) => { player = progress; } };

/** Topics that change only the texts next to the picture. They are shown even while the picture is frozen. */
const LIVE_TOPICS = ["robot", "status", "replay"];
// Newest message of each topic while the picture is frozen.
let heldMessages = null;
// Whether the frozen picture is the map of a site.
let isHeldMap = false;
// Whether the frozen picture must be cleared at its release.
let clearOnRelease = false;

const lastPart = (topic) => topic.slice(topic.lastIndexOf("/") + 1);

function take(topic, buffer, offset) {
  const kind = lastPart(topic);
  const sensor = kind === "scan" && sensorAt(topic);
  if (sensor) sensor.scans += 1;
  if (heldMessages && !LIVE_TOPICS.includes(kind)) return heldMessages.set(topic, [buffer, offset]);
  show(topic, buffer, offset);
  if (sensor) sensor.stamp = Number(new DataView(buffer).getBigUint64(5, true)) / 1e6;
  requestDraw();
}

function show(topic, buffer, offset) {
  const kind = lastPart(topic);
  if (rosHandlers[kind]) rosHandlers[kind](topic, buffer, offset);
  else jsonHandlers[kind]?.(JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, offset))), topic);
}

// The WebSocket.

let socket = null;
let isOpen = false;
let retryDelay = 250;
// Topics by channel ID, which is also the ID of the subscription.
const topics = new Map();

/** Returns whether the page needs `topic` now. Line features and clouds cost other programs CPU time, so the page
 * subscribes to them only while it shows them. */
function isNeeded(topic) {
  const kind = lastPart(topic);
  return kind === "lines" ? layers.lines : kind === "cloud" ? isSideView() : !["tilt", "tf_static"].includes(kind);
}

/** Subscribes to the needed topics, and unsubscribes from all others. A repeated subscription changes nothing. */
function subscribe() {
  if (!isOpen) return;
  const ids = [...topics.keys()];
  const needed = ids.filter((id) => isNeeded(topics.get(id)));
  socket.send(JSON.stringify({ op: "unsubscribe", subscriptionIds: ids.filter((id) => !needed.includes(id)) }));
  socket.send(JSON.stringify({ op: "subscribe", subscriptions: needed.map((id) => ({ id, channelId: id })) }));
}

function connect() {
  socket = new WebSocket(`${location.origin.replace("http", "ws")}/${location.search}`, "foxglove.sdk.v1");
  socket.binaryType = "arraybuffer";
  topics.clear();
  socket.onopen = () => {
    isOpen = true;
    retryDelay = 250;
  };
  socket.onmessage = ({ data }) => {
    if (typeof data !== "string") {
      const view = new DataView(data);
      const topic = view.getUint8(0) === 1 && topics.get(view.getUint32(1, true));
      if (topic) take(topic, data, 13);
      return;
    }
    const message = JSON.parse(data);
    if (message.op === "serverInfo") startRun(message.sessionId);
    else if (message.op === "advertise") {
      for (const { id, topic } of message.channels) {
        topics.set(id, topic);
        if (lastPart(topic) === "cloud") sweepAt(topic);
      }
      subscribe();
    } else if (message.op === "status") {
      $("news").textContent = message.message;
      setTimeout(() => { if ($("news").textContent === message.message) $("news").textContent = ""; }, 4000);
    }
  };
  socket.onclose = () => {
    isOpen = false;
    setTimeout(connect, retryDelay);
    retryDelay = min(2 * retryDelay, 2000);
    requestDraw();
  };
}
