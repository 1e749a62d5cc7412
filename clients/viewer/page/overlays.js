// Draws everything in the picture except points.

function drawZones() {
  font("600 12", "bottom");
  const [x, y] = toScreen(0, 0);
  for (const { radius, verdict } of circles) {
    const isViolated = verdict !== "clear";
    ink(colors[verdict], isViolated ? 2.5 : 1.5);
    circle(x, y, radius * view.scale);
    if (isViolated) {
      pen.globalAlpha = 0.09;
      pen.fill();
      pen.globalAlpha = 1;
    }
    pen.setLineDash(isViolated ? [] : [6, 5]);
    pen.stroke();
    pen.setLineDash([]);
    label(`${radius.toFixed(2)} m${isViolated ? " !" : ""}`, x, y - radius * view.scale - 4);
  }
  for (const { points: [from, to], verdict } of beams) {
    ink(colors[verdict], 2);
    stroke(toScreen(from.x, from.y), toScreen(to.x, to.y));
    circle(...toScreen(to.x, to.y), 5.5);
    pen.stroke();
  }
  return circles.length;
}

function drawMarks() {
  ink(colors.paper, 1.5);
  pen.fillStyle = colors.mark;
  for (const mark of marks) {
    const [x, y] = toScreen(mark.x, mark.y);
    path([x, y - 8], [x + 7, y], [x, y + 8], [x - 7, y]);
    pen.closePath();
    pen.fill();
    pen.stroke();
  }
  return marks.length;
}

function drawLines() {
  ink(colors.line, 2);
  for (const [from, to] of walls) stroke(toScreen(from.x, from.y), toScreen(to.x, to.y));
  for (const corner of corners) {
    const [x, y] = toScreen(corner.x, corner.y);
    pen.strokeRect(x - 4.5, y - 4.5, 9, 9);
  }
  return walls.length;
}

/** Draws people with ID, tail and uncertainty. People who are not seen are dashed and pale. Returns the number of
 * people. */
function drawPeople() {
  ink(colors.person, 2);
  font("600 13", "bottom");
  const all = allPeople();
  for (const { id, state, x, y, across, tail, reach } of all) {
    const [px, py] = toScreen(x, y);
    const radius = max(7, (across / 2) * view.scale);
    pen.globalAlpha = 0.15;
    pen.beginPath();
    pen.ellipse(px, py, reach.x * view.scale, reach.y * view.scale, PI / 2 - reach.yaw + view.turn, 0, 2 * PI);
    pen.fill();
    pen.globalAlpha = state === "confirmed" ? 1 : 0.5;
    if (layers.trails) stroke(...tail.map((at) => toScreen(at.x, at.y)));
    if (state !== "confirmed") pen.setLineDash([4, 4]);
    circle(px, py, radius);
    pen.stroke();
    pen.setLineDash([]);
    label(`#${id}`, px, py - radius - 3);
  }
  pen.globalAlpha = 1;
  return all.length;
}

function drawTape() {
  if (!tape) return;
  const [from, to] = [toScreen(...tape.from), toScreen(...tape.to)];
  ink(colors.accent, 2);
  stroke(from, to);
  for (const [x, y] of [from, to]) {
    circle(x, y, 4);
    pen.fill();
  }
  const meters = hypot(tape.to[0] - tape.from[0], tape.to[1] - tape.from[1]);
  font("600 14", "bottom");
  label(`${meters.toFixed(3)} m`, (from[0] + to[0]) / 2, (from[1] + to[1]) / 2 - 8);
}

function drawSensors() {
  font("600 11", "middle");
  const visible = shownSensors();
  allSensors().forEach((sensor, n) => {
    const pose = poseOf(sensor);
    if (!pose || !visible.includes(sensor)) return;
    const [x, y] = toScreen(pose[4], pose[5]);
    circle(x, y, 8.5);
    ink(colors.paper, 1.5);
    pen.fill();
    ink(colors.ink, 1.5);
    pen.stroke();
    pen.fillText(String(n + 1), x, y + 0.5);
  });
}
