// What the server says, and the socket that it comes through.

/** Little-endian CDR: values at multiples of their size behind four bytes of head. */
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

/** How many points a cloud has, and what reads a field of one of them: a float, a byte. */
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
  const place = (i, field) => at + i * step + fields[field];
  return { count, f32: (i, field) => view.getFloat32(place(i, field), true), u8: (i, field) => view.getUint8(place(i, field)) };
}

const SHADES = 24;

function takeScan(topic, buffer, offset) {
  const sensor = sensorAt(topic);
  const told = laserScan(buffer, offset);
  const { ranges, intensities, first, step } = told;
  const points = places(ranges, first, step);
  // What is bright is told over minutes: colours that breathe cannot be read.
  sensor.brightest = intensities.reduce((most, one) => max(most, one), max(1, 0.9995 * (sensor.brightest ?? 1)));
  const byShade = Array.from({ length: intensities.length ? SHADES : 0 }, () => []);
  intensities.forEach((one, i) => {
    if (Number.isNaN(points[2 * i])) return;
    byShade[min(SHADES - 1, floor(SHADES * Math.sqrt(one / sensor.brightest)))].push(points[2 * i], points[2 * i + 1]);
  });
  isFitDue = true;
  sensor.scan = { ...told, points, byShade, at: performance.now() };
}

function takeForeground(topic, buffer, offset) {
  const sensor = sensorAt(topic);
  const now = performance.now();
  const { count, f32 } = pointCloud(buffer, offset);
  sensor.foreground = Float32Array.from({ length: 2 * count }, (_, n) => f32(n >> 1, n % 2 ? "y" : "x"));
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

/** Where a sensor sits, as [xx, xy, yx, yy, x, y]: upside down it is a mirror. Nothing as long as nobody told, and what it sees is
 * nowhere. */
function poseOf({ status }) {
  if (!status?.pose) return null;
  const { x_m, y_m, yaw_rad, upside_down } = status.pose;
  const [c, s, sign] = [Math.cos(yaw_rad), Math.sin(yaw_rad), upside_down ? -1 : 1];
  return [c, -s * sign, s, c * sign, x_m, y_m];
}

const told = (entity) => Object.fromEntries(entity.metadata.map(({ key, value }) => [key, value]));

function takeZones(update) {
  circles = [];
  beams = [];
  for (const entity of update.entities) {
    const said = told(entity);
    if (entity.cylinders.length) circles.push({ radius: Number(said.radius_m), verdict: said.verdict });
    for (const line of entity.lines) beams.push({ points: line.points, ...said });
  }
}

const spheres = (update) => update.entities.flatMap((entity) => entity.spheres.map((one) => one.pose.position));

function takeLines(update) {
  walls = update.entities.flatMap((entity) => entity.lines).flatMap(({ points }) =>
    points.flatMap((from, n) => (n % 2 ? [] : [[from, points[n + 1]]])));
  corners = spheres(update);
}

function takeTracks(update, topic) {
  const persons = update.entities.map((entity) => {
    const [body, reach] = entity.cylinders;
    const { z, w } = reach.pose.orientation;
    return { ...told(entity), ...body.pose.position, across: body.size.x, tail: entity.lines[0].points,
      reach: { x: reach.size.x / 2, y: reach.size.y / 2, yaw: 2 * atan2(z, w) } };
  });
  people.set(topic, { at: performance.now(), persons });
}

function takeStatus(status, topic) {
  const sensor = sensorAt(topic);
  const now = performance.now();
  const loss = max(status.lost_share ?? 0, status.damaged);
  sensor.status = { ...status, loss };
  sensor.name = status.name;
  sensor.history.push({ at: now, hz: status.hz ?? 0, loss, age: status.age_p99_ms ?? 0 });
  while (now - sensor.history[0].at > HISTORY_MS) sensor.history.shift();
  if (status.trouble && !kept) Object.assign(sensor, blind());
  isFitDue = true;
}

function takeRobot(said) {
  const was = robot.hub;
  robot = said;
  heard = performance.now();
  if (was && !said.hub) forget();
}

/** What becomes of a message, by the last word of its topic: of one of ROS, and of an object of JSON. */
const ofRos = { scan: takeScan, foreground: takeForeground, background: takeBackground, cloud: takeCloud };
const ofJson = { robot: takeRobot, status: takeStatus, zones: takeZones, lines: takeLines, tracks: takeTracks, obstacles: takeObstacles,
  marks: (update) => { marks = spheres(update); }, replay: (progress) => { player = progress; } };

/** What makes the words beside the picture, and not the picture. */
const BESIDE = ["robot", "status", "replay"];
// The newest message of each topic, while the picture is frozen.
let kept = null;
// Whether the frozen picture is the map of a site.
let isHeldMap = false;
// Clear the frozen picture at its release.
let isHeldGone = false;

const lastWord = (topic) => topic.slice(topic.lastIndexOf("/") + 1);

function take(topic, buffer, offset) {
  const word = lastWord(topic);
  const sensor = word === "scan" && sensorAt(topic);
  if (sensor) sensor.scans += 1;
  if (kept && !BESIDE.includes(word)) return kept.set(topic, [buffer, offset]);
  show(topic, buffer, offset);
  if (sensor) sensor.stamp = Number(new DataView(buffer).getBigUint64(5, true)) / 1e6;
  wake();
}

function show(topic, buffer, offset) {
  const word = lastWord(topic);
  if (ofRos[word]) ofRos[word](topic, buffer, offset);
  else ofJson[word]?.(JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, offset))), topic);
}

// The socket.

let socket = null;
let isOpen = false;
let retry = 250;
// By channel, which is the number of its subscription, too.
const topics = new Map();

/** Whoever asks for lines and points costs others something: that is done while they are looked at. */
function isWanted(topic) {
  const word = lastWord(topic);
  return word === "lines" ? layers.lines : word === "cloud" ? isAside() : !["tilt", "tf_static"].includes(word);
}

/** Asks for what is wanted, and for nothing else; what is asked for again stays as it is. */
function follow() {
  if (!isOpen) return;
  const ids = [...topics.keys()];
  const wanted = ids.filter((id) => isWanted(topics.get(id)));
  socket.send(JSON.stringify({ op: "unsubscribe", subscriptionIds: ids.filter((id) => !wanted.includes(id)) }));
  socket.send(JSON.stringify({ op: "subscribe", subscriptions: wanted.map((id) => ({ id, channelId: id })) }));
}

function connect() {
  socket = new WebSocket(`${location.origin.replace("http", "ws")}/${location.search}`, "foxglove.sdk.v1");
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
    if (said.op === "serverInfo") enter(said.sessionId);
    else if (said.op === "advertise") {
      for (const { id, topic } of said.channels) {
        topics.set(id, topic);
        if (lastWord(topic) === "cloud") sweepAt(topic);
      }
      follow();
    } else if (said.op === "status") {
      $("news").textContent = said.message;
      setTimeout(() => { if ($("news").textContent === said.message) $("news").textContent = ""; }, 4000);
    }
  };
  socket.onclose = () => {
    isOpen = false;
    setTimeout(connect, retry);
    retry = min(2 * retry, 2000);
    wake();
  };
}
