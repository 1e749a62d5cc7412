// Data of the picture. The page is a viewer of foxglove.sdk.v1 like any other. It keeps the newest data of each sensor
// and draws it in the robot's coordinates: x ahead, y left, in meters.

const { PI, abs, atan2, ceil, floor, hypot, max, min } = Math;
const $ = (id) => document.getElementById(id);
const map = $("map");
let pen = map.getContext("2d");

// By namespace, as "/front".
const sensors = new Map();
// The last message of topic `robot`.
let robot = {};
// ID of the server's run.
let session = null;
let circles = [];
// Beams that violate a zone.
let beams = [];
let marks = [];
// Straight surfaces, as pairs of ends.
let walls = [];
let corners = [];
// Tracks, and the time of their arrival, by topic of the tracker.
const people = new Map();
// Sweeps of tilted scanners, by namespace.
const sweeps = new Map();
// State of the replay, if this server plays a recording.
let player = null;
// Time of the last verdict.
let heard = -Infinity;
let frames = 0;
// Time of a scan, and end of the frame that shows it, in ms since 1970, by one machine's clock.
const ages = [];
const drawn = { beams: 0, foreground: 0, zones: 0, marks: 0, lines: 0, tracks: 0, obstacles: 0, swept: 0, axes: 0 };

// The verdict is unknown after this silence.
const SILENT_MS = 500;
// A scan is stale after this time.
const OLD_MS = 1000;
const TRAIL_MS = 1600;
const TRAIL_STEP_MS = 90;
const HISTORY_MS = 120_000;

/** Returns the entry of `all` that a topic belongs to, and creates it with `made`. It belongs to this run of the server. */
function owner(all, topic, made) {
  const space = topic.slice(0, topic.lastIndexOf("/"));
  if (!all.has(space)) all.set(space, { space, name: space.slice(1).replaceAll("/", "."), ...made() });
  return Object.assign(all.get(space), { session });
}

/** Of a sensor, and of who makes sweeps, that sees nothing. */
const blind = () => ({ scan: null, foreground: null, trail: [] });
const empty = () => ({ sweep: null, points: null, obstacles: [] });

const sensorAt = (topic) =>
  owner(sensors, topic, () => ({ ...blind(), scans: 0, history: [] }));
const everySensor = () => [...sensors.values()];
const everySweep = () => [...sweeps.values()];
const sweepAt = (topic) => owner(sweeps, topic, empty);

/** Returns whether the picture is the map of a site, where the robot's position is unknown. */
const isMap = () => (kept ? isHeldMap : Boolean(robot.map));

/** Clears all but the background, because the hub has exited. A frozen picture stays until its release. */
function forget() {
  if (kept) {
    kept.clear();
    isHeldGone = true;
    return;
  }
  isHeldGone = false;
  for (const sensor of sensors.values()) Object.assign(sensor, blind());
  for (const one of sweeps.values()) Object.assign(one, empty());
  [circles, beams, marks, walls, corners] = [[], [], [], [], []];
  people.clear();
}

/** Removes the entries of other runs of the server. A frozen picture keeps them until its release. */
function dropOthers() {
  if (kept) return;
  for (const all of [sensors, sweeps]) {
    for (const [space, one] of all) {
      if (one.session === session) continue;
      one.card?.card.remove();
      all.delete(space);
      if (only === space) only = null;
    }
  }
}

/** Starts with the run `id` of the server. Nothing of another run is valid. */
function enter(id) {
  if (session !== null && id !== session) {
    forget();
    [robot, heard, player] = [{}, -Infinity, null];
  }
  session = id;
  dropOthers();
}
