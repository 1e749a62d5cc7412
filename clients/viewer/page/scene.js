// Data of the picture. The page is a viewer of foxglove.sdk.v1 like any other. It keeps the newest data of each sensor
// and draws it in the robot's coordinates: x ahead, y left, in meters.

const { PI, abs, atan2, ceil, floor, hypot, max, min } = Math;
const $ = (id) => document.getElementById(id);
const map = $("map");
let pen = map.getContext("2d");

// Sensors by namespace, such as "/front".
const sensors = new Map();
// Last message of topic `robot`.
let robot = {};
// ID of the server's run.
let session = null;
let circles = [];
// Beams that violate a zone.
let beams = [];
let marks = [];
// Straight surfaces, each as a pair of its ends.
let walls = [];
let corners = [];
// Tracks, and the arrival time of the tracks, by topic of the tracker.
const people = new Map();
// Sweeps of tilted scanners, by namespace.
const sweeps = new Map();
// State of the replay, if this server plays a recording.
let player = null;
// Arrival time of the last message of topic `robot`.
let lastRobotAt = -Infinity;
let frames = 0;
// Pairs of the time of a scan and the end of the frame that shows the scan, in ms since 1970. Both times come from the
// clock of one machine.
const ages = [];
const drawn = { beams: 0, foreground: 0, zones: 0, marks: 0, lines: 0, tracks: 0, obstacles: 0, swept: 0, axes: 0 };

// Time without a message after which the verdict is unknown.
const SILENCE_MS = 500;
// Time after which a scan is stale.
const STALE_AFTER_MS = 1000;
const TRAIL_MS = 1600;
const TRAIL_STEP_MS = 90;
const HISTORY_MS = 120_000;

/** Returns the entry of `all` for the namespace of a topic, and creates the entry with `create` if the namespace is
 * new. Marks the entry as one of this run of the server. */
function entryFor(all, topic, create) {
  const space = topic.slice(0, topic.lastIndexOf("/"));
  if (!all.has(space)) all.set(space, { space, name: space.slice(1).replaceAll("/", "."), ...create() });
  return Object.assign(all.get(space), { session });
}

/** Returns the empty data of a sensor. */
const emptySensor = () => ({ scan: null, foreground: null, trail: [] });
const emptySweep = () => ({ sweep: null, points: null, obstacles: [] });

const sensorAt = (topic) =>
  entryFor(sensors, topic, () => ({ ...emptySensor(), scans: 0, history: [] }));
const allSensors = () => [...sensors.values()];
const allSweeps = () => [...sweeps.values()];
const sweepAt = (topic) => entryFor(sweeps, topic, emptySweep);

/** Returns whether the picture is the map of a site, where the robot's position is unknown. */
const isMap = () => (heldMessages ? isHeldMap : Boolean(robot.map));

/** Clears everything except the background, because the hub has exited. A frozen picture stays until its release. */
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

/** Starts with the run `id` of the server. Data of another run is not valid. */
function startRun(id) {
  if (session !== null && id !== session) {
    clearPicture();
    [robot, lastRobotAt, player] = [{}, -Infinity, null];
  }
  session = id;
  dropOtherRuns();
}
