// The visible part of the world, and its position on the screen.

/** Layers of the picture, each with its key and its name. */
const LAYERS = {
  scan: ["s", "Scan"], intensity: ["i", "Intensity"], foreground: ["f", "Foreground"], trails: ["t", "Trails"],
  background: ["b", "Background"], zones: ["z", "Zones"], marks: ["m", "Marks"], lines: ["e", "Lines and corners"],
  obstacles: ["o", "Obstacles"], field: ["v", "Field of view"], grid: ["g", "Grid"],
};
const layers = Object.fromEntries(Object.keys(LAYERS).map((name) => [name, name !== "lines"]));
// Restore the layers chosen earlier in this window. Browsers may refuse access to the storage.
try {
  Object.assign(layers, JSON.parse(sessionStorage.getItem("layers")));
} catch { /* The choice is valid while the page is open. */ }
const views = ["above", "aside"].map(() => ({ x: 1, y: 0, scale: 60, turn: 0, fits: true, isFitted: false, goal: null }));
let view = views[0];
const isSideView = () => view === views[1];
// Namespace of the only sensor that is shown; null for all sensors.
let shownSpace = null;
const isMotionReduced = matchMedia("(prefers-reduced-motion: reduce)");
// Position of the pointer over the picture, in pixels.
let pointer = null;
// Measured distance: { from, to } in meters.
let tape = null;
let isTape = false;
let size = { width: 1, height: 1, ratio: 1 };

/** Widths of the margins that boxes cover, in pixels. */
let covered = { top: 0, right: 0, bottom: 0 };

/** Measures the margins. The margins do not shrink while the window keeps its size, because text that changes must not
 * move the picture. */
function measureMargins() {
  const box = (name) => document.querySelector(name).getBoundingClientRect();
  const isNarrow = size.width <= 720;
  const lower = [isNarrow ? "aside" : "#player", "nav"].map(box).find(({ height }) => height);
  const now = { top: box("header").bottom + 8, right: isNarrow ? 0 : size.width - box("aside").left, bottom: size.height - lower.top + 8 };
  const before = covered;
  covered = Object.fromEntries(Object.entries(now).map(([side, width]) => [side, max(width, before[side])]));
  if (Object.keys(now).some((side) => covered[side] !== before[side])) {
    isFitDue = true;
    requestDraw();
  }
}

/** Returns the part of the window that is not covered by a box. */
function freeArea() {
  const { top, right, bottom } = covered;
  const [width, height] = [size.width - right, max(1, size.height - top - bottom)];
  return { x: width / 2, y: top + height / 2, width, height };
}

function toScreen(x, y) {
  const { x: cx, y: cy } = middle;
  const [a, b] = [-(y - view.y) * view.scale, -(x - view.x) * view.scale];
  return [cx + a * cos - b * sin, cy + a * sin + b * cos];
}

/** Transforms a point from a sensor's frame to the robot's frame. */
const inFrame = ([xx, xy, yx, yy, x, y], px, py) => [xx * px + xy * py + x, yx * px + yy * py + y];

/** Returns the transform from a sensor's frame to the screen, as the six numbers of a canvas transform. */
function onScreen([xx, xy, yx, yy, x, y]) {
  const [c, s] = [cos * view.scale, sin * view.scale];
  return [xx * s - yx * c, -xx * c - yx * s, xy * s - yy * c, -xy * c - yy * s, ...toScreen(x, y)];
}

function toRobot(px, py) {
  const [a, b] = [px - middle.x, py - middle.y];
  return [view.x - (-a * sin + b * cos) / view.scale, view.y - (a * cos + b * sin) / view.scale];
}

let middle = { x: 0, y: 0, width: 1, height: 1 };
let [cos, sin] = [1, 0];

function updateView() {
  middle = freeArea();
  // In the side view, the robot is turned instead of the picture.
  [cos, sin] = isSideView() ? [1, 0] : [Math.cos(view.turn), Math.sin(view.turn)];
}

/** Returns the scanner on the mount. Returns null if no sweep has arrived, or if this machine has several scanners,
 * because then it is unknown which scanner is on the mount. */
function tiltedSensor() {
  const local = allSensors().filter(({ status }) => status && !status.remote);
  return allSweeps().some(({ sweep }) => sweep) && local.length === 1 ? local[0] : null;
}

const shownSensors = () => allSensors().filter((sensor) => (shownSpace === null ? !sensor.status?.remote || !hasLocalSensor() : sensor.space === shownSpace));
const hasLocalSensor = () => allSensors().some((sensor) => sensor.status && !sensor.status.remote);

/** Returns all visible points with their frames, and a function that returns the text about a point. */
const allPoints = () => (isSideView() ? sidePoints() : shownSensors().filter((one) => one.scan && poseOf(one)).map((one) =>
  ({ points: one.scan.points, pose: poseOf(one), text: (beam) => beamText(one, beam) })));

const MARGIN = 1.1;

/** Fits the visible points into the picture, without a few outliers. Keeps the current view if the points fit well
 * enough. */
function fit() {
  const visible = allPoints();
  // A few hundred points are enough to find the edges of the picture.
  const stride = 2 * ceil(visible.reduce((sum, { points }) => sum + points.length, 0) / 1000);
  const [xs, ys] = [[], []];
  for (const { points, pose } of visible) {
    const [a, b, c, d, e, f] = onScreen(pose);
    for (let i = 0; i < points.length; i += stride) {
      const [x, y] = [points[i], points[i + 1]];
      if (Number.isNaN(x)) continue;
      xs.push(a * x + c * y + e);
      ys.push(b * x + d * y + f);
    }
  }
  if (!xs.length) return;
  const reach = max(0.5, ...(isSideView() ? [] : circles.map(({ radius }) => radius))) * 1.08 * view.scale;
  const robotAt = toScreen(0, 0);
  // The side view shows nothing below the floor, except for points.
  const below = isSideView() ? 0 : reach;
  const [[left, right], [top, bottom]] = [xs, ys].map((unsorted, n) => {
    const values = Float32Array.from(unsorted).sort();
    const outliers = floor(values.length / 50);
    return [min(values[outliers], robotAt[n] - reach), max(values[values.length - 1 - outliers], robotAt[n] + (n ? below : reach))];
  });
  // In the side view, the floor is at the bottom, with space for the numbers and the name of its axis.
  const bottomSpace = isSideView() ? min(44, middle.height / 4) : 0;
  const scale = (view.scale * min(middle.width / (right - left), (middle.height - bottomSpace) / (bottom - top))) / MARGIN;
  const centerY = isSideView() ? bottom + ((bottomSpace - middle.height / 2) * view.scale) / scale : (top + bottom) / 2;
  const [x, y] = toRobot((left + right) / 2, centerY);
  const goal = { scale, x, y };
  const now = view.goal ?? view;
  const moved = hypot(goal.x - now.x, goal.y - now.y) * scale;
  // Keep the view while it fits, because a moving view is hard to read.
  const isOffFloor = isSideView() && abs(goal.x - now.x) * scale > 12;
  const isOut = scale * MARGIN < now.scale * 0.99 || moved > 0.12 * min(middle.width, middle.height) || isOffFloor;
  if (isOut || now.scale < 0.6 * scale || !view.isFitted) Object.assign(view, { goal, isFitted: true });
}

/** Moves the view toward its goal. Returns whether it moves. */
function moveToGoal() {
  if (!view.goal) return false;
  const share = isMotionReduced.matches ? 1 : 0.16;
  const { x, y, scale } = view.goal;
  view.x += (x - view.x) * share;
  view.y += (y - view.y) * share;
  view.scale *= (scale / view.scale) ** share;
  if (abs(Math.log(scale / view.scale)) < 0.002 && hypot(x - view.x, y - view.y) * scale < 0.5) {
    Object.assign(view, view.goal, { goal: null });
  }
  return true;
}
