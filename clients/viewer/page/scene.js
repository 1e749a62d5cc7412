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
// Arrival of the last message of topic `robot`.
let lastRobotAt = -Infinity;
let frames = 0;
// Time of a scan, and end of the frame that shows it, in ms since 1970, by one machine's clock.
const ages = [];
const drawn = { beams: 0, foreground: 0, zones: 0, marks: 0, lines: 0, tracks: 0, obstacles: 0, swept: 0, axes: 0 };

// The verdict is unknown after this silence.
const SILENCE_MS = 500;
// A scan is stale after this time.
const STALE_AFTER_MS = 1000;
const TRAIL_MS = 1600;
const TRAIL_STEP_MS = 90;
const HISTORY_MS = 120_000;

/** Returns the entry of `all` that a topic belongs to, and creates it with `create`. It belongs to this run of the server. */
function entryFor(all, topic, create) {
  const space = topic.slice(0, topic.lastIndexOf("/"));
  if (!all.has(space)) all.set(space, { space, name: space.slice(1).replaceAll("/", "."), ...create() });
  return Object.assign(all.get(space), { session });
}

/** Returns the empty data of a sensor. `empty` does so for a source of sweeps. */
const emptySensor = () => ({ scan: null, foreground: null, trail: [] });
const emptySweep = () => ({ sweep: null, points: null, obstacles: [] });

const sensorAt = (topic) =>
  entryFor(sensors, topic, () => ({ ...emptySensor(), scans: 0, history: [] }));
const allSensors = () => [...sensors.values()];
const allSweeps = () => [...sweeps.values()];
const sweepAt = (topic) => entryFor(sweeps, topic, emptySweep);

/** Returns whether the picture is the map of a site, where the robot's position is unknown. */
const isMap = () => (heldMessages ? isHeldMap : Boolean(robot.map));

/** Clears all but the background, because the hub has exited. A frozen picture stays until its release. */
function clearPicture() {
  if (heldMessages) {
    heldMessages.clear();
    clearOnRelease = true;
    return;
  }
  clearOnRelease = false;
  for (const sensor of sensors.values()) Object.assign(sensor, emptySensor());
  for (const one of sweeps.values()) Object.assign(one, emptySweep());
  [circles, beams, marks, walls, corners] = [[], [], [], [], []];
  people.clear();
}

/** Removes the entries of other runs of the server. A frozen picture keeps them until its release. */
function dropOtherRuns() {
  if (heldMessages) return;
  for (const all of [sensors, sweeps]) {
    for (const [space, one] of all) {
      if (one.session === session) continue;
      one.card?.card.remove();
      all.delete(space);
      if (shownSpace === space) shownSpace = null;
    }
  }
}

/** Starts with the run `id` of the server. Nothing of another run is valid. */
function startRun(id) {
  if (session !== null && id !== session) {
    clearPicture();
    [robot, lastRobotAt, player] = [{}, -Infinity, null];
  }
  session = id;
  dropOtherRuns();
}
