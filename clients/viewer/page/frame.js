// Frames of the picture.

function drawTopView(now) {
  const visible = shownSensors();
  // Background and foreground in two dimensions have no meaning for a scanner on a mount, because they change with the
  // mount's angle.
  const level = visible.filter((sensor) => sensor !== tiltedSensor());
  if (layers.field) visible.forEach(drawField);
  if (layers.grid) drawGrid();
  if (layers.background) {
    pen.fillStyle = colors.old;
    for (const sensor of level) dots(sensor.background, 2.5, poseOf(sensor));
  }
  if (layers.trails) for (const sensor of level) drawTrail(sensor, now);
  if (layers.zones) drawn.zones = drawZones();
  if (layers.scan) for (const sensor of visible) drawn.beams += drawScan(sensor);
  if (layers.foreground) {
    pen.fillStyle = colors.new;
    for (const sensor of level) drawn.foreground += dots(sensor.foreground, 5, poseOf(sensor));
  }
  if (layers.lines) drawn.lines = drawLines();
  if (layers.marks) drawn.marks = drawMarks();
  drawn.tracks = drawPeople();
  // The robot's position in the map of a site is unknown.
  if (!isMap()) drawRobot();
  if (layers.obstacles && !isMap()) drawn.obstacles = drawObstacles();
  drawSensors();
  if (layers.grid) drawAxisNames();
}

function draw(now) {
  updateView();
  if (view.fits && isFitDue && !heldMessages) fit();
  isFitDue = false;
  const isMoving = moveToGoal();
  pen.setTransform(size.ratio, 0, 0, size.ratio, 0, 0);
  pen.fillStyle = colors.paper;
  pen.fillRect(0, 0, size.width, size.height);
  for (const kind in drawn) drawn[kind] = 0;
  if (isSideView()) drawSideView();
  else drawTopView(now);
  drawTape();
  showPointer();
  showVerdict();
  frames += 1;
  for (const sensor of shownSensors()) {
    if (sensor.stamp) ages.push([sensor.stamp, performance.timeOrigin + performance.now()]);
    sensor.stamp = null;
  }
  ages.splice(0, ages.length - 400);
  return isMoving;
}

let isDrawRequested = false;
// Whether data has arrived, or the view has changed, since the last frame.
let isFitDue = false;

function requestDraw() {
  if (isDrawRequested) return;
  isDrawRequested = true;
  requestAnimationFrame((now) => {
    isDrawRequested = false;
    let isAnimating = draw(now);
    for (const sensor of sensors.values()) {
      sensor.trail = sensor.trail.filter(({ at }) => now - at < TRAIL_MS);
      isAnimating ||= sensor.trail.length > 0;
    }
    if (isAnimating) requestDraw();
  });
}

function resize() {
  for (const one of views) one.isFitted = false;
  isFitDue = true;
  size = { width: innerWidth, height: innerHeight, ratio: min(devicePixelRatio || 1, 3) };
  covered = { top: 0, right: 0, bottom: 0 };
  measureMargins();
  map.width = Math.round(size.width * size.ratio);
  map.height = Math.round(size.height * size.ratio);
  requestDraw();
}
