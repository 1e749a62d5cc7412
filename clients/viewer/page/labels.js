// Texts next to the picture.

/** Formats a number with this number of decimals, and without the sign of a negative zero. */
const fixed = (value, digits) => value.toFixed(digits).replace(/^-(?=[0.]*$)/, "");

function beamText({ scan, name }, beam) {
  const angle = ((scan.first + beam * scan.step) * 180) / PI;
  const intensity = scan.byShade.length ? `, intensity ${scan.intensities[beam]}` : "";
  return `\n${name}: ${fixed(angle, 2)}\u00b0, ${fixed(scan.ranges[beam], 3)} m${intensity}`;
}

/** Writes the reading of the point under the pointer, or the pointer's position. */
function showPointer() {
  const box = $("readout");
  if (!pointer || tape) return box.replaceChildren();
  let best = { apart: 14 };
  for (const { points, pose, text } of layers.scan ? allPoints() : []) {
    const [a, b, c, d, e, f] = onScreen(pose);
    for (let i = 0; i < points.length; i += 2) {
      const x = a * points[i] + c * points[i + 1] + e;
      const y = b * points[i] + d * points[i + 1] + f;
      const apart = hypot(x - pointer[0], y - pointer[1]);
      if (apart < best.apart) best = { apart, text, beam: i / 2, screen: [x, y] };
    }
  }
  const [x, y] = toRobot(...(best.screen ?? pointer));
  const bold = make("b");
  bold.textContent = isSideView() ? `${fixed(x, 2)} m above the floor` : `${fixed(hypot(x, y), 2)} m from the ${isMap() ? "map's origin" : "robot"}`;
  const position = isSideView() ? `${fixed(-y, 2)} m ${sideAxisName()}` : `x ${fixed(x, 2)}  y ${fixed(y, 2)} m`;
  box.replaceChildren(bold, `\n${position}`, best.text?.(best.beam) ?? "");
  if (!best.screen) return;
  ink(colors.accent, 2);
  circle(...best.screen, 7);
  pen.stroke();
}

const allPeople = () => [...people.values()].flatMap((one) => one.tracks);

/** Returns whether the picture stays as it is, because the player is paused or at the end. */
const isPlayerStopped = () => player !== null && (player.paused || player.over);
const isReceiving = () => isOpen && performance.now() - lastRobotAt < SILENCE_MS;
const verdict = () => (isReceiving() ? robot.verdict : "unknown");

function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Writes the verdict. Called for each frame, so that text and zones describe the same moment. */
function showVerdict() {
  // Zones are around the robot, and the position of the robot in the map of a site is unknown.
  const isSite = isReceiving() && robot.hub && robot.map;
  const shownVerdict = verdict();
  const box = $("verdict");
  box.className = isSite ? "map" : shownVerdict;
  box.hidden = isSite && !heldMessages;
  box.firstElementChild.hidden = isSite;
  put(box.firstElementChild, shownVerdict.toUpperCase());
  const { sensor, nearest_m, hub_words: hub } = isReceiving() ? robot : {};
  const nearest = isSite ? "" : [sensor, nearest_m && `nearest ${nearest_m.toFixed(2)} m`].filter(Boolean).join(", ");
  put(box.lastElementChild, [nearest, heldMessages && "picture held"].filter(Boolean).join("  ·  "));
  put($("hub"), hub ?? "");
  put($("title"), isSite ? "scanhub" : `${shownVerdict.toUpperCase()} – scanhub`);
}

function replaceData(one, data) {
  Object.assign(one, data);
  requestDraw();
}

/** Deletes data that is too old at `now`. */
function expireData(now) {
  for (const one of allSensors()) if (one.scan && now - one.scan.at > max(STALE_AFTER_MS, 3000 * one.scan.period)) replaceData(one, emptySensor());
  for (const one of allSweeps()) {
    // The page subscribes to points only in the side view.
    if (!isSideView()) one.points = null;
    if (one.sweep && now > one.until) replaceData(one, emptySweep());
  }
  for (const one of people.values()) if (one.tracks.length && now - one.at > STALE_AFTER_MS) replaceData(one, { tracks: [] });
}

function updateTexts() {
  const now = performance.now();
  showVerdict();
  if (!isReceiving() && (circles.length || allSensors().some(({ scan }) => scan))) {
    clearPicture();
    requestDraw();
  }
  if (!heldMessages && !isPlayerStopped()) expireData(now);
  put($("people"), peopleText());
  put($("swept"), allSweeps().map(sweepText).join("; "));
  buttonOf("side").hidden = !sweeps.size;
  showPlayer();
  showProblem();
  showLegend();
  measureMargins();
}

/** Returns the people in each room as text. If an ID is greater than the number of people, adds the number of tracks so
 * far. */
function peopleText() {
  if (!isReceiving() || !robot.people) return "";
  const all = allPeople();
  const latest = max(0, ...all.map(({ id }) => Number(id)));
  return latest > all.length ? `${robot.people}  ·  tracks so far: ${latest}` : robot.people;
}

/** Updates the scale of the intensities, and the legend of objects that are not in the list of layers. */
function showLegend() {
  const limits = shownSensors().filter(({ scan }) => scan?.byShade.length).map(({ brightest }) => Math.round(brightest));
  const [limit, ...others] = new Set(limits);
  $("scale").hidden = limit === undefined || isSideView();
  // The shade is proportional to the square root of the intensity.
  const numbers = others.length ? [0, "", "highest of each sensor"] : [0, limit < 4 ? "" : Math.round(limit / 4), limit];
  const [canvas, texts] = $("scale").children;
  [...texts.children].forEach((text, n) => put(text, String(numbers[n])));
  const { clientWidth: width, clientHeight: height } = canvas;
  if (width) {
    drawOn(canvas, () => shadeColors.forEach((shade, n) => {
      ink(shade, 1);
      pen.fillRect((n * width) / SHADES, 0, width / SHADES + 1, height);
    }), width, height);
  }
  for (const one of document.querySelectorAll("#layers [data-view]")) {
    one.hidden = one.dataset.view === "aside" ? !isSideView() : !allPeople().length;
  }
}

function showPlayer() {
  const box = $("player");
  box.hidden = !player;
  if (!player) return;
  const { position_s: at, length_s: length, paused, over, words } = player;
  put($("played"), words);
  Object.assign($("line"), { hidden: length === null, max: length ?? 1, value: at });
  const button = box.querySelector("[data-order=toggle]");
  put(button, paused ? "Play" : "Pause");
  for (const one of box.querySelectorAll("button")) one.disabled = over || !isOpen;
}

/** Writes the reason why the picture is empty, and the remedy. */
function showProblem() {
  const [first] = shownSensors();
  let problem = robot.problem ?? (robot.hub ? null : { what: "No hub", remedy: "scanhub run" });
  if (!isOpen) problem = { what: "No connection to scanhub web", remedy: "It ended, or the network between is cut. This page tries again by itself." };
  else if (!isReceiving()) problem = { what: "No data from scanhub web", remedy: "Look at its terminal." };
  else if (!problem && first?.status?.problem && shownSensors().every(({ scan }) => !scan)) {
    const { what, remedy } = first.status.problem;
    problem = { what: `${first.name}: ${what}`, remedy };
  }
  if (!problem && isSideView() && !sidePoints().length) {
    problem = allSweeps().some(({ sweep }) => sweep) ? { what: "Waiting for the next sweep", remedy: "" }
      : { what: $("swept").textContent, remedy: "Does the mount swing from turn to turn, and does scanhub tilt run?" };
  }
  const box = $("reason");
  box.hidden = !problem;
  if (problem) {
    put(box.firstElementChild, problem.what);
    put(box.lastElementChild, problem.remedy);
  }
}

const FIELDS = [
  ["rate", "hz", ({ hz }) => (hz === null ? "–" : `${hz.toFixed(1)} Hz`)],
  ["age p50 / p99", "age", ({ age_p50_ms: p50, age_p99_ms: p99 }) => (p50 === null ? "–" : `${millis(p50)} / ${millis(p99)} ms`)],
  ["damaged on the line", "loss", ({ loss }) => percent(loss)],
  ["lost on the line; missed by this program", null, ({ lost_on_line: line, missed }) => `${line ?? "–"} / ${missed}`],
];
// Long values have no decimals, so that two values fit in a line.
const millis = (ms) => ms.toFixed(ms < 100 ? 1 : 0);
const percent = (share) => `${(100 * share).toFixed(!share ? 0 : share < 0.1 ? 2 : 1)} %`;
const LOSS_THRESHOLD = 0.001;

function make(tag, parent, name = "") {
  const element = document.createElement(tag);
  element.className = name;
  parent?.append(element);
  return element;
}

function makeCard(sensor) {
  const card = make("article", $("sensors"));
  const title = make("h2", card);
  sensor.card = { card, title: make("button", title), state: make("i", title), kind: make("div", card, "kind"), problem: make("p", card, "problem"), fields: [] };
  const list = make("dl", card);
  for (const [label, series, text] of FIELDS) {
    const field = make("div", list);
    make("dt", field).textContent = label;
    const value = make("dd", field);
    const number = make("span", value);
    const line = series && make("canvas", value);
    const scale = line && make("small", value);
    for (const one of [line, scale]) one?.setAttribute("aria-hidden", "true");
    sensor.card.fields.push({ field, number, line, scale, series, text });
  }
  sensor.card.title.onclick = () => selectSensor(sensor.space);
}

function showSensors() {
  allSensors().forEach((sensor, n) => {
    const { status } = sensor;
    if (!status) return;
    if (!sensor.card) makeCard(sensor);
    const { card, title, state, kind, problem, fields } = sensor.card;
    const isHere = isReceiving() && robot.hub && sensor.session === session;
    const stateText = isHere ? status.state : "no status";
    const isLossy = status.loss > LOSS_THRESHOLD;
    card.className = [stateText.replace(" ", "-"), isLossy ? "lossy" : "", shownSensors().includes(sensor) ? "" : "off"].join(" ");
    put(title, `${n + 1}  ${sensor.name}`);
    press(title, shownSpace === sensor.space);
    put(state, stateText + (status.frozen ? ", frozen" : ""));
    put(kind, [status.family, status.model, status.port].filter(Boolean).join(" · "));
    const problemShown = isHere && status.problem;
    put(problem, problemShown ? [problemShown.what, problemShown.remedy].filter(Boolean).join(": ") : isLossy && isHere ? lossText(status) : "");
    for (const { field, number, line, scale, series, text } of fields) {
      put(number, isHere ? text(status) : "–");
      field.className = series === "loss" && isLossy ? "amber" : "";
      if (line) put(scale, sparkline(line, sensor.history, series));
    }
  });
}

/** Returns a text about the losses on a line, with their reason or the remedy. */
function lossText({ loss, simulated, replayed }) {
  const line = simulated ? "simulated line" : replayed ? "recorded line" : "line";
  const remedy = replayed ? "" : simulated ? ": simulated faults, or this machine is too busy" : ": check cable, ground and rate";
  return `${percent(loss)} of its ${line} is damaged or lost${remedy}`;
}

/** Texts of the scales of sparklines, from 0 to `top`. */
const SCALES = { hz: (top) => `0–${top} Hz`, age: (top) => `p99, 0–${top} ms`, loss: (top) => `0–${fixed(100 * top, 0)} %` };

/** Returns the next round value above `value`. */
function roundUp(value) {
  const power = 10 ** floor(Math.log10(value));
  return power * [1, 2, 5, 10].find((step) => step * power >= value || step === 10);
}

/** Draws the values of the last two minutes. The scale starts at 0, so that small variations do not look like a
 * problem. Returns the scale as text. */
function sparkline(canvas, history, series) {
  const { clientWidth: width, clientHeight: height } = canvas;
  const now = performance.now();
  const top = roundUp(max(series === "loss" ? 0.01 : 1, ...history.map((one) => one[series])));
  const isLossFree = series === "loss" && history.every(({ loss }) => loss <= LOSS_THRESHOLD);
  drawOn(canvas, () => {
    ink(colors.edge, 1);
    stroke([0, height - 0.5], [width, height - 0.5]);
    ink(isLossFree ? colors.soft : series === "loss" ? colors.slow : colors.accent, 1.5);
    pen.lineJoin = "round";
    stroke(...history.map((one) => [width - ((now - one.at) / HISTORY_MS) * width, height - 1 - (one[series] / top) * (height - 3)]));
  }, width, height);
  return `${SCALES[series](top)}, ${HISTORY_MS / 60_000} min`;
}
