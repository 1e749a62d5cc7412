// Draws sweeps of tilted scanners from the side. Up is x of the view, and right is -y, which is ahead unless the view
// is turned.

const CLASSES = ["unknown", "background", "foreground", "behind"];
/** Looks of the classes: class, color, width in pixels, shape and layer. The shapes differ, so that color is not the only cue.
 * Later entries are drawn on top. */
const LOOKS = [["background", "old", 2, "fillRect", "background"], ["unknown", "soft", 2.5, "fillRect", "scan"],
  ["behind", "line", 5, "strokeRect", "foreground"], ["foreground", "new", 4, "fillRect", "foreground"]];
/** Transform from pairs of right and up to the view, in the form of a sensor's pose. */
const ASIDE = [0, 1, -1, 0, 0, 0];

function takeCloud(topic, buffer, offset) {
  const { count, f32, u8 } = pointCloud(buffer, offset);
  const points = CLASSES.map(() => []);
  for (let i = 0; i < count; i++) (points[u8(i, "class")] ?? points[0]).push(f32(i, "x"), f32(i, "y"), f32(i, "z"));
  Object.assign(sweepAt(topic), { points, turn: null, at: performance.now() });
  isFitDue = true;
}

function takeObstacles(update, topic) {
  const [sweep, ...boxes] = update.entities;
  const { sec, nsec } = sweep.lifetime;
  Object.assign(sweepAt(topic), { sweep: told(sweep), until: performance.now() + 1e3 * sec + nsec / 1e6,
    obstacles: boxes.map((one) => ({ ...told(one), ...one.cubes[0] })) });
}

/** Returns the direction of the horizontal axis of the side view. */
const toTheSide = () => (view.turn ? "to the right" : "ahead");

const toTheRight = (x, y) => x * Math.cos(view.turn) - y * Math.sin(view.turn);

/** Returns pairs of right and up for each class of each sweep. They are computed once per sweep and turn. */
const pointsAside = () => everySweep().filter(({ points }) => points).flatMap((one) => {
  if (one.turn !== view.turn) {
    one.turn = view.turn;
    one.pairs = one.points.map((xyz, n) => {
      const points = new Float32Array((xyz.length / 3) * 2);
      for (let i = 0, to = 0; i < xyz.length; i += 3, to += 2) {
        points[to] = toTheRight(xyz[i], xyz[i + 1]);
        points[to + 1] = xyz[i + 2];
      }
      return { points, pose: ASIDE, of: CLASSES[n], words: () => `\n${one.name}: ${CLASSES[n]}` };
    });
  }
  return one.pairs;
});

const sheet = make("canvas");
// Key of the canvas's content, and number of points on the canvas.
let onSheet = {};

/** Draws all points, and returns their number. They are drawn once per sweep and view on a separate canvas, which is copied to
 * each frame. */
function drawPoints() {
  const all = pointsAside();
  const key = JSON.stringify([view, size, layers, colours.paper, everySweep().map(({ at, points }) => points && at)]);
  if (key !== onSheet.key) {
    onSheet = { key, count: 0 };
    drawOn(sheet, () => {
      for (const [of, colour, width, how, layer] of LOOKS) {
        ink(colours[colour], 1);
        for (const one of all) if (one.of === of && layers[layer]) onSheet.count += dots(one.points, width, ASIDE, how);
      }
    });
  }
  pen.drawImage(sheet, 0, 0, size.width, size.height);
  return onSheet.count;
}

/** Draws a box around each obstacle, with its distance, and `!` if it is too near. Returns the number of obstacles. */
function drawObstacles() {
  const all = everySweep().flatMap(({ obstacles }) => obstacles);
  font("600 12", "bottom");
  for (const { pose: { position: at }, size, distance_m, near } of all) {
    const ends = Array.from({ length: 8 }, (_, n) => {
      const [x, y, z] = ["x", "y", "z"].map((axis, bit) => at[axis] + size[axis] * ((n >> bit) % 2 - 0.5));
      return isAside() ? toScreen(z, -toTheRight(x, y)) : toScreen(x, y);
    });
    const [left, top, right, bottom] = [min, max].flatMap((most) => [0, 1].map((n) => most(...ends.map((end) => end[n]))));
    const isNear = near === "true";
    ink(isNear ? colours.stop : colours.new, 2);
    pen.strokeRect(left, top, right - left, bottom - top);
    label(`${Number(distance_m).toFixed(2)} m${isNear ? " !" : ""}`, (left + right) / 2, top - 4);
  }
  return all.length;
}

function drawFromTheSide() {
  if (layers.grid) drawGrid();
  const [, floor] = toScreen(0, 0);
  ink(colours.soft, 2);
  stroke([0, floor], [size.width, floor]);
  drawn.swept = drawPoints();
  drawRobot();
  if (layers.obstacles) drawn.obstacles = drawObstacles();
  if (layers.grid) drawAxisNames();
}

const sweepWords = ({ name, sweep, until }) => `${name}: ${sweep?.words ?? (until ? "no sweep any more" : "no sweep yet")}`;
