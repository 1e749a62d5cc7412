// The picture, frame by frame.

function drawFromAbove(now) {
  const seen = shown();
  // Background and foreground in two dimensions have no meaning for a scanner on a mount: they change with its angle.
  const level = seen.filter((sensor) => sensor !== tiltedSensor());
  if (layers.field) seen.forEach(drawField);
  if (layers.grid) drawGrid();
  if (layers.background) {
    pen.fillStyle = colours.old;
    for (const sensor of level) dots(sensor.background, 2.5, poseOf(sensor));
  }
  if (layers.trails) for (const sensor of level) drawTrail(sensor, now);
  if (layers.zones) drawn.zones = drawZones();
  if (layers.scan) for (const sensor of seen) drawn.beams += drawScan(sensor);
  if (layers.foreground) {
    pen.fillStyle = colours.new;
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
  place();
  if (view.fits && isFitDue && !kept) fit();
  isFitDue = false;
  const moves = glide();
  pen.setTransform(size.ratio, 0, 0, size.ratio, 0, 0);
  pen.fillStyle = colours.paper;
  pen.fillRect(0, 0, size.width, size.height);
  for (const sign in drawn) drawn[sign] = 0;
  if (isAside()) drawFromTheSide();
  else drawFromAbove(now);
  drawTape();
  readOut();
  tellVerdict();
  frames += 1;
  for (const sensor of shown()) {
    if (sensor.stamp) ages.push([sensor.stamp, performance.timeOrigin + performance.now()]);
    sensor.stamp = null;
  }
  ages.splice(0, ages.length - 400);
  return moves;
}

let isAwake = false;
let isFitDue = false; // something came, or the view is another one

function wake() {
  if (isAwake) return;
  isAwake = true;
  requestAnimationFrame((now) => {
    isAwake = false;
    let goesOn = draw(now);
    for (const sensor of sensors.values()) {
      sensor.trail = sensor.trail.filter(({ at }) => now - at < TRAIL_MS);
      goesOn ||= sensor.trail.length > 0;
    }
    if (goesOn) wake();
  });
}

function resize() {
  for (const one of views) one.isFitted = false;
  isFitDue = true;
  size = { width: innerWidth, height: innerHeight, ratio: min(devicePixelRatio || 1, 3) };
  covered = { top: 0, right: 0, bottom: 0 };
  measure();
  map.width = Math.round(size.width * size.ratio);
  map.height = Math.round(size.height * size.ratio);
  wake();
}
