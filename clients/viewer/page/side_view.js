// Draws sweeps of tilted scanners from the side. Up is x of the view, and right is -y, which is ahead unless the view
// is turned.

const CLASSES = ["unknown", "background", "foreground", "behind"];
/** Class, color, width, method of the pen, and layer. Classes differ in width and shape too, because not everyone can
 * distinguish the colors. Points of later entries are drawn above points of earlier entries. */
const CLASS_STYLES = [["background", "old", 2, "fillRect", "background"], ["unknown", "soft", 2.5, "fillRect", "scan"],
  ["behind", "line", 5, "strokeRect", "foreground"], ["foreground", "new", 4, "fillRect", "foreground"]];
/** Transform of pairs of right and up to the view. It has the form of a sensor's pose. */
const SIDE_POSE = [0, 1, -1, 0, 0, 0];

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
  Object.assign(sweepAt(topic), { sweep: metadataOf(sweep), until: performance.now() + 1e3 * sec + nsec / 1e6,
    obstacles: boxes.map((one) => ({ ...metadataOf(one), ...one.cubes[0] })) });
}

/** Direction of the horizontal axis of the side view. */
const sideAxisName = () => (view.turn ? "to the right" : "ahead");

const rightOf = (x, y) => x * Math.cos(view.turn) - y * Math.sin(view.turn);

/** Returns a list of pairs of right and up for each class of each sweep. The lists of a sweep are computed again only
 * if the view is turned. */
const sidePoints = () => allSweeps().filter(({ points }) => points).flatMap((one) => {
  if (one.turn !== view.turn) {
    one.turn = view.turn;
    one.pairs = one.points.map((xyz, n) => {
      const points = new Float32Array((xyz.length / 3) * 2);
      for (let i = 0, to = 0; i < xyz.length; i += 3, to += 2) {
        points[to] = rightOf(xyz[i], xyz[i + 1]);
        points[to + 1] = xyz[i + 2];
      }
      return { points, pose: SIDE_POSE, pointClass: CLASSES[n], text: () => `\n${one.name}: ${CLASSES[n]}` };
    });
  }
  return one.pairs;
});

const pointsCanvas = make("canvas");
// Content of the canvas, and number of points on the canvas.
let pointsCanvasState = {};

/** Draws all points, and returns their number. The points are drawn on a canvas that each frame copies. They are drawn
 * again only if a sweep or the view changes. */
function drawPoints() {
  const all = sidePoints();
  const key = JSON.stringify([view, size, layers, colors.paper, allSweeps().map(({ at, points }) => points && at)]);
  if (key !== pointsCanvasState.key) {
    pointsCanvasState = { key, count: 0 };
    drawOn(pointsCanvas, () => {
      for (const [pointClass, color, width, method, layer] of CLASS_STYLES) {
        ink(colors[color], 1);
        for (const one of all) if (one.pointClass === pointClass && layers[layer]) pointsCanvasState.count += dots(one.points, width, SIDE_POSE, method);
      }
    });
  }
  pen.drawImage(pointsCanvas, 0, 0, size.width, size.height);
  return pointsCanvasState.count;
}

/** Draws a box around each obstacle, with the obstacle's distance, and `!` if the obstacle is near. Both views use this
 * function. Returns the number of obstacles. */
function drawObstacles() {
  const all = allSweeps().flatMap(({ obstacles }) => obstacles);
  font("600 12", "bottom");
  for (const { pose: { position: at }, size, distance_m, near } of all) {
    const ends = Array.from({ length: 8 }, (_, n) => {
      const [x, y, z] = ["x", "y", "z"].map((axis, bit) => at[axis] + size[axis] * ((n >> bit) % 2 - 0.5));
      return isSideView() ? toScreen(z, -rightOf(x, y)) : toScreen(x, y);
    });
    const [left, top, right, bottom] = [min, max].flatMap((extreme) => [0, 1].map((n) => extreme(...ends.map((end) => end[n]))));
    const isNear = near === "true";
    ink(isNear ? colors.stop : colors.new, 2);
    pen.strokeRect(left, top, right - left, bottom - top);
    label(`${Number(distance_m).toFixed(2)} m${isNear ? " !" : ""}`, (left + right) / 2, top - 4);
  }
  return all.length;
}

function drawSideView() {
  if (layers.grid) drawGrid();
  const [, floor] = toScreen(0, 0);
  ink(colors.soft, 2);
  stroke([0, floor], [size.width, floor]);
  drawn.swept = drawPoints();
  drawRobot();
  if (layers.obstacles) drawn.obstacles = drawObstacles();
  if (layers.grid) drawAxisNames();
}

const sweepText = ({ name, sweep, until }) => `${name}: ${sweep?.words ?? (until ? "no sweep any more" : "no sweep yet")}`;
