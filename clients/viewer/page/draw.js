// Drawing functions, and the parts that both views share.

const colors = {};
let shadeColors = [];
let isDark = false;

function readColors() {
  const probe = make("span", document.body);
  for (const name of document.styleSheets[0].cssRules[0].style) {
    probe.style.color = `var(${name})`;
    colors[name.slice(2)] = getComputedStyle(probe).color;
  }
  colors.unknown = colors.stop;
  // The background color shows whether the page is dark.
  const [red] = colors.paper.match(/[\d.]+/g).map(Number);
  isDark = red < (colors.paper.includes("srgb") ? 0.5 : 128);
  probe.remove();
  const stops = isDark
    ? [[92, 124, 196], [70, 176, 214], [116, 214, 158], [250, 220, 96]]
    : [[52, 78, 148], [28, 120, 150], [24, 146, 98], [196, 120, 0]];
  shadeColors = Array.from({ length: SHADES }, (_, n) => {
    const at = (n / (SHADES - 1)) * (stops.length - 1);
    const [low, high] = [stops[floor(at)], stops[ceil(at)]];
    return `rgb(${low.map((value, i) => Math.round(value + (high[i] - value) * (at % 1))).join(" ")})`;
  });
}

const STEPS = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50];

/** Sets the color of the following shapes and texts, and the line width in pixels. */
function ink(color, width) {
  pen.strokeStyle = pen.fillStyle = color;
  pen.lineWidth = width;
}

/** Sets the font of the following texts. They are centered horizontally, and `baseline` defines their vertical
 * position. */
function font(size, baseline) {
  pen.font = `${size}px system-ui, sans-serif`;
  pen.textAlign = "center";
  pen.textBaseline = baseline;
}

/** Starts a path through positions on the screen. */
function path(...points) {
  pen.beginPath();
  for (const point of points) pen.lineTo(...point);
}

/** Draws a line through points of the screen. */
function stroke(...points) {
  path(...points);
  pen.stroke();
}

/** Clears `canvas`, and calls `paint`, whose drawing goes to `canvas` instead of the picture. */
function drawOn(canvas, paint, width = size.width, height = size.height) {
  [canvas.width, canvas.height] = [width * size.ratio, height * size.ratio];
  const before = pen;
  pen = canvas.getContext("2d");
  pen.scale(size.ratio, size.ratio);
  paint();
  pen = before;
}

function circle(x, y, radius) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, 2 * PI);
}

/** Draws text with an outline in the background color, so that lines do not cross it. */
function label(text, x, y) {
  pen.save();
  pen.lineWidth = 4;
  pen.lineJoin = "round";
  pen.strokeStyle = colors.paper;
  pen.strokeText(text, x, y);
  pen.restore();
  pen.fillText(text, x, y);
}

/** Returns both axes, the vertical axis first. `at` converts a position along the axis, and the position along the
 * other axis, to the screen. `right` and `down` point to the side on which the axis has its numbers. */
function axes() {
  return [
    { center: view.x, at: (n, other) => toScreen(n, other), other: view.y, right: cos, down: sin, sign: 1,
      name: isSideView() ? "height, m" : "x ahead, m" },
    { center: view.y, at: (n, other) => toScreen(other, n), other: view.x, right: -sin, down: cos, sign: isSideView() ? -1 : 1,
      name: isSideView() ? `${sideAxisName()} along the floor, m` : "y left, m" },
  ];
}

/** Returns the distance between grid lines in meters. */
const gridStep = () => STEPS.find((length) => length * view.scale >= 64) ?? 100;
const gridReach = () => hypot(size.width, size.height) / view.scale / 2 + gridStep();

/** Returns whether nothing covers a text of this width at a position on the screen. */
const isFree = ([x, y], width) => x > width / 2 + 8 && x < middle.width - width / 2 - 8 && abs(y - middle.y) < middle.height / 2 - 8;

function drawGrid() {
  const [step, reach] = [gridStep(), gridReach()];
  const digits = step < 0.1 ? 2 : step < 1 ? 1 : 0;
  // Omit the number of a grid line where a zone has its label.
  const hasNumber = (n) => n !== 0 && !(layers.zones && !isSideView() && circles.some(({ radius }) => abs(abs(n * step) - radius) * view.scale < 26));
  const forEachGridLine = (paint) => {
    for (const axis of axes()) for (let n = ceil((axis.center - reach) / step); n * step <= axis.center + reach; n++) paint(n, axis);
  };
  for (const isAxis of [false, true]) {
    ink(isAxis ? colors.axis : colors.grid, 1);
    forEachGridLine((n, { at, other }) => { if ((n === 0) === isAxis) stroke(at(n * step, other - reach), at(n * step, other + reach)); });
  }
  ink(colors.soft, 1);
  font(11, "middle");
  forEachGridLine((n, { at, right, down, sign }) => {
    const [x, y] = at(n * step, 0);
    if (hasNumber(n) && isFree([x, y], 24)) label((sign * n * step).toFixed(digits), x + 13 * right, y + 11 * down);
  });
}

/** Writes the name of each axis near its positive end, between two numbers. Called last, so that points do not hide
 * the name. */
function drawAxisNames() {
  const [step, reach] = [gridStep(), gridReach()];
  ink(colors.soft, 1);
  font(11, "middle");
  for (const { at, right, down, sign, name, center } of axes()) {
    const { width } = pen.measureText(name);
    const apart = abs(right) * (width / 2 + 7) + abs(down) * 25;
    const last = sign * floor((sign * center + reach) / step);
    for (let offset = 0.5; offset * step < 2 * reach; offset++) {
      const [x, y] = at((last - sign * offset) * step, 0);
      const position = [x + right * apart, y + down * apart];
      if (!isFree(position, width)) continue;
      drawn.axes += 1;
      label(name, ...position);
      break;
    }
  }
}

function drawRobot() {
  const [x, y] = toScreen(0, 0);
  ink(colors.ink, 1);
  path(...[[11, 0], [-7, 7], [-3.5, 0], [-7, -7]].map(([ahead, left]) => {
    const [a, b] = isSideView() ? [ahead * Math.cos(view.turn), left] : [-left, -ahead];
    return [x + a * cos - b * sin, y + a * sin + b * cos];
  }));
  pen.fill();
}

function drawField(sensor) {
  const { scan } = sensor;
  const pose = poseOf(sensor);
  if (!scan || !pose) return;
  const far = min(scan.farthest, 2 * hypot(size.width, size.height) / view.scale);
  const center = toScreen(pose[4], pose[5]);
  const rim = Array.from({ length: 61 }, (_, n) => {
    const angle = scan.first + ((scan.last - scan.first) * n) / 60;
    return toScreen(...inFrame(pose, far * Math.cos(angle), far * Math.sin(angle)));
  });
  const isFullCircle = scan.last - scan.first > 6.2;
  path(...(isFullCircle ? [] : [center]), ...rim);
  pen.fillStyle = colors.shade;
  pen.fill();
  if (!isFullCircle) {
    ink(colors.axis, 1);
    pen.setLineDash([1, 5]);
    stroke(rim[0], center, rim[60]);
    pen.setLineDash([]);
  }
}

// Distance between two points in pixels. If it is smaller, the previous point hides the next one.
const MIN_DOT_DISTANCE = 0.8;

/** Draws squares of `width` pixels at `points` of a sensor at `pose`, with the canvas method `method`. Returns the
 * number of points that are not NaN. */
function dots(points, width, pose, method = "fillRect") {
  if (!points || !pose) return 0;
  const [a, b, c, d, e, f] = onScreen(pose);
  const [left, top] = [e - width / 2, f - width / 2];
  let [count, px, py] = [0, NaN, NaN];
  for (let i = 0; i < points.length; i += 2) {
    const x = left + a * points[i] + c * points[i + 1];
    const y = top + b * points[i] + d * points[i + 1];
    if (x !== x) continue;
    count += 1;
    // Skip points that the previous square hides, because drawing them takes as much time as drawing visible points.
    if (abs(x - px) < MIN_DOT_DISTANCE && abs(y - py) < MIN_DOT_DISTANCE) continue;
    pen[method](x, y, width, width);
    [px, py] = [x, y];
  }
  return count;
}

function drawScan(sensor) {
  const { scan } = sensor;
  if (!scan) return 0;
  const pose = poseOf(sensor);
  const width = scan.points.length > 2000 ? 2.5 : 3.5;
  const shades = layers.intensity && scan.byShade.length ? scan.byShade : [scan.points];
  // Draw all points of a shade together, so that each color is set only once.
  return shades.reduce((count, points, shade) => {
    pen.fillStyle = shades.length > 1 ? shadeColors[shade] : colors.ink;
    return count + dots(points, width, pose);
  }, 0);
}

function drawTrail(sensor, now) {
  pen.fillStyle = colors.new;
  for (const { at, points } of sensor.trail) {
    pen.globalAlpha = 0.34 * max(0, 1 - (now - at) / TRAIL_MS);
    dots(points, 3, poseOf(sensor));
  }
  pen.globalAlpha = 1;
}
