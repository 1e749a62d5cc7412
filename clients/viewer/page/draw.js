// What a picture is drawn with, and what all pictures have.

const colours = {};
let shadeColours = [];
let isDark = false;

function readColours() {
  const probe = make("span", document.body);
  for (const name of document.styleSheets[0].cssRules[0].style) {
    probe.style.color = `var(${name})`;
    colours[name.slice(2)] = getComputedStyle(probe).color;
  }
  colours.unknown = colours.stop;
  // Whether it is dark is told by the paper.
  const [red] = colours.paper.match(/[\d.]+/g).map(Number);
  isDark = red < (colours.paper.includes("srgb") ? 0.5 : 128);
  probe.remove();
  const stops = isDark
    ? [[92, 124, 196], [70, 176, 214], [116, 214, 158], [250, 220, 96]]
    : [[52, 78, 148], [28, 120, 150], [24, 146, 98], [196, 120, 0]];
  shadeColours = Array.from({ length: SHADES }, (_, n) => {
    const at = (n / (SHADES - 1)) * (stops.length - 1);
    const [low, high] = [stops[floor(at)], stops[ceil(at)]];
    return `rgb(${low.map((value, i) => Math.round(value + (high[i] - value) * (at % 1))).join(" ")})`;
  });
}

const STEPS = [0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50];

/** The colour of what is drawn and written next, and how wide lines are. */
function ink(colour, width) {
  pen.strokeStyle = pen.fillStyle = colour;
  pen.lineWidth = width;
}

/** The font of what is written next, around its place or above. */
function font(size, baseline) {
  pen.font = `${size}px system-ui, sans-serif`;
  pen.textAlign = "center";
  pen.textBaseline = baseline;
}

/** A way through places of the screen, and a line there. */
function path(...places) {
  pen.beginPath();
  for (const place of places) pen.lineTo(...place);
}

function stroke(...places) {
  path(...places);
  pen.stroke();
}

/** Draws on another canvas, which is empty before. */
function drawOn(canvas, act, width = size.width, height = size.height) {
  [canvas.width, canvas.height] = [width * size.ratio, height * size.ratio];
  const before = pen;
  pen = canvas.getContext("2d");
  pen.scale(size.ratio, size.ratio);
  act();
  pen = before;
}

function circle(x, y, radius) {
  pen.beginPath();
  pen.arc(x, y, radius, 0, 2 * PI);
}

/** Words with the paper around them, so that no line runs through. */
function label(text, x, y) {
  pen.save();
  pen.lineWidth = 4;
  pen.lineJoin = "round";
  pen.strokeStyle = colours.paper;
  pen.strokeText(text, x, y);
  pen.restore();
  pen.fillText(text, x, y);
}

/** Returns both axes, upright first: where index `n` of a grid line is, and the side on which the axis has its numbers. */
function axes() {
  return [
    { centre: view.x, at: (n, other) => toScreen(n, other), other: view.y, right: cos, down: sin, sign: 1,
      name: isAside() ? "height, m" : "x ahead, m" },
    { centre: view.y, at: (n, other) => toScreen(other, n), other: view.x, right: -sin, down: cos, sign: isAside() ? -1 : 1,
      name: isAside() ? `${toTheSide()} along the floor, m` : "y left, m" },
  ];
}

/** Distance of grid lines in meters. */
const gridStep = () => STEPS.find((length) => length * view.scale >= 64) ?? 100;
const gridReach = () => hypot(size.width, size.height) / view.scale / 2 + gridStep();

/** Returns whether a text of this width at a place of the screen is not covered. */
const isFree = ([x, y], width) => x > width / 2 + 8 && x < middle.width - width / 2 - 8 && abs(y - middle.y) < middle.height / 2 - 8;

function drawGrid() {
  const [step, reach] = [gridStep(), gridReach()];
  const digits = step < 0.1 ? 2 : step < 1 ? 1 : 0;
  // The label of a zone takes the place of a number.
  const isBare = (n) => n !== 0 && !(layers.zones && !isAside() && circles.some(({ radius }) => abs(abs(n * step) - radius) * view.scale < 26));
  const each = (act) => {
    for (const axis of axes()) for (let n = ceil((axis.centre - reach) / step); n * step <= axis.centre + reach; n++) act(n, axis);
  };
  for (const isAxis of [false, true]) {
    ink(isAxis ? colours.axis : colours.grid, 1);
    each((n, { at, other }) => { if ((n === 0) === isAxis) stroke(at(n * step, other - reach), at(n * step, other + reach)); });
  }
  ink(colours.soft, 1);
  font(11, "middle");
  each((n, { at, right, down, sign }) => {
    const [x, y] = at(n * step, 0);
    if (isBare(n) && isFree([x, y], 24)) label((sign * n * step).toFixed(digits), x + 13 * right, y + 11 * down);
  });
}

/** Writes the name of each axis near its positive end, between two numbers. Called last, so that points do not hide it. */
function drawAxisNames() {
  const [step, reach] = [gridStep(), gridReach()];
  ink(colours.soft, 1);
  font(11, "middle");
  for (const { at, right, down, sign, name, centre } of axes()) {
    const { width } = pen.measureText(name);
    const apart = abs(right) * (width / 2 + 7) + abs(down) * 25;
    const last = sign * floor((sign * centre + reach) / step);
    for (let back = 0.5; back * step < 2 * reach; back++) {
      const [x, y] = at((last - sign * back) * step, 0);
      const place = [x + right * apart, y + down * apart];
      if (!isFree(place, width)) continue;
      drawn.axes += 1;
      label(name, ...place);
      break;
    }
  }
}

function drawRobot() {
  const [x, y] = toScreen(0, 0);
  ink(colours.ink, 1);
  path(...[[11, 0], [-7, 7], [-3.5, 0], [-7, -7]].map(([ahead, left]) => {
    const [a, b] = isAside() ? [ahead * Math.cos(view.turn), left] : [-left, -ahead];
    return [x + a * cos - b * sin, y + a * sin + b * cos];
  }));
  pen.fill();
}

function drawField(sensor) {
  const { scan } = sensor;
  const pose = poseOf(sensor);
  if (!scan || !pose) return;
  const far = min(scan.farthest, 2 * hypot(size.width, size.height) / view.scale);
  const centre = toScreen(pose[4], pose[5]);
  const rim = Array.from({ length: 61 }, (_, n) => {
    const angle = scan.first + ((scan.last - scan.first) * n) / 60;
    return toScreen(...inFrame(pose, far * Math.cos(angle), far * Math.sin(angle)));
  });
  const isTurn = scan.last - scan.first > 6.2;
  path(...(isTurn ? [] : [centre]), ...rim);
  pen.fillStyle = colours.shade;
  pen.fill();
  if (!isTurn) {
    ink(colours.axis, 1);
    pen.setLineDash([1, 5]);
    stroke(rim[0], centre, rim[60]);
    pen.setLineDash([]);
  }
}

const HIDDEN = 0.8; // pixels

/** Squares of `width` at `points` of a sensor at `pose`, drawn as `how` says; how many of them are numbers. */
function dots(points, width, pose, how = "fillRect") {
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
    if (abs(x - px) < HIDDEN && abs(y - py) < HIDDEN) continue;
    pen[how](x, y, width, width);
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
  // A colour is set once for all that have it.
  return shades.reduce((count, points, shade) => {
    pen.fillStyle = shades.length > 1 ? shadeColours[shade] : colours.ink;
    return count + dots(points, width, pose);
  }, 0);
}

function drawTrail(sensor, now) {
  pen.fillStyle = colours.new;
  for (const { at, points } of sensor.trail) {
    pen.globalAlpha = 0.34 * max(0, 1 - (now - at) / TRAIL_MS);
    dots(points, 3, poseOf(sensor));
  }
  pen.globalAlpha = 1;
}
