// What is said in words.

/** So many digits behind the point; what rounds to nothing has no sign. */
const fixed = (value, digits) => value.toFixed(digits).replace(/^-(?=[0.]*$)/, "");

function beamWords({ scan, name }, beam) {
  const angle = ((scan.first + beam * scan.step) * 180) / PI;
  const intensity = scan.byShade.length ? `, intensity ${scan.intensities[beam]}` : "";
  return `\n${name}: ${fixed(angle, 2)}\u00b0, ${fixed(scan.ranges[beam], 3)} m${intensity}`;
}

/** What is under the pointer: a point, or a place. */
function readOut() {
  const box = $("readout");
  if (!pointer || tape) return box.replaceChildren();
  let best = { apart: 14 };
  for (const { points, pose, words } of layers.scan ? allPoints() : []) {
    const [a, b, c, d, e, f] = onScreen(pose);
    for (let i = 0; i < points.length; i += 2) {
      const x = a * points[i] + c * points[i + 1] + e;
      const y = b * points[i] + d * points[i + 1] + f;
      const apart = hypot(x - pointer[0], y - pointer[1]);
      if (apart < best.apart) best = { apart, words, beam: i / 2, screen: [x, y] };
    }
  }
  const [x, y] = toRobot(...(best.screen ?? pointer));
  const bold = make("b");
  bold.textContent = isAside() ? `${fixed(x, 2)} m above the floor` : `${fixed(hypot(x, y), 2)} m from the ${isMap() ? "map's origin" : "robot"}`;
  const place = isAside() ? `${fixed(-y, 2)} m ${toTheSide()}` : `x ${fixed(x, 2)}  y ${fixed(y, 2)} m`;
  box.replaceChildren(bold, `\n${place}`, best.words?.(best.beam) ?? "");
  if (!best.screen) return;
  ink(colours.accent, 2);
  circle(...best.screen, 7);
  pen.stroke();
}

const persons = () => [...people.values()].flatMap((one) => one.persons);

/** What a player shows while it waits stands. */
const stands = () => player !== null && (player.paused || player.over);
const isHeard = () => isOpen && performance.now() - heard < SILENT_MS;
const verdict = () => (isHeard() ? robot.verdict : "unknown");

function put(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Writes the verdict. Called for each frame, so that text and zones describe the same moment. */
function tellVerdict() {
  // Zones are around the robot, whose position in the map of a site is unknown.
  const isSite = isHeard() && robot.hub && robot.map;
  const word = verdict();
  const box = $("verdict");
  box.className = isSite ? "map" : word;
  box.hidden = isSite && !kept;
  box.firstElementChild.hidden = isSite;
  put(box.firstElementChild, word.toUpperCase());
  const { sensor, nearest_m, hub_words: hub } = isHeard() ? robot : {};
  const nearest = isSite ? "" : [sensor, nearest_m && `nearest ${nearest_m.toFixed(2)} m`].filter(Boolean).join(", ");
  put(box.lastElementChild, [nearest, kept && "picture held"].filter(Boolean).join("  ·  "));
  put($("hub"), hub ?? "");
  put($("title"), isSite ? "scanhub" : `${word.toUpperCase()} – scanhub`);
}

function lose(one, left) {
  Object.assign(one, left);
  wake();
}

/** Forgets what is too old to be what is there. */
function age(now) {
  for (const one of everySensor()) if (one.scan && now - one.scan.at > max(OLD_MS, 3000 * one.scan.period)) lose(one, blind());
  for (const one of everySweep()) {
    if (!isAside()) one.points = null; // Nobody follows them.
    if (one.sweep && now > one.until) lose(one, empty());
  }
  for (const one of people.values()) if (one.persons.length && now - one.at > OLD_MS) lose(one, { persons: [] });
}

function tell() {
  const now = performance.now();
  tellVerdict();
  if (!isHeard() && (circles.length || everySensor().some(({ scan }) => scan))) {
    forget();
    wake();
  }
  if (!kept && !stands()) age(now);
  put($("people"), peopleWords());
  put($("swept"), everySweep().map(sweepWords).join("; "));
  buttonOf("side").hidden = !sweeps.size;
  tellPlayer();
  explain();
  tellLegend();
  measure();
}

/** Returns who is in which room, and for numbers that are greater than their count, the reason. */
function peopleWords() {
  if (!isHeard() || !robot.people) return "";
  const all = persons();
  const latest = max(0, ...all.map(({ id }) => Number(id)));
  return latest > all.length ? `${robot.people}  ·  tracks so far: ${latest}` : robot.people;
}

/** Writes the scale of the intensities, and the colors of the things that are not in the list of layers. */
function tellLegend() {
  const limits = shown().filter(({ scan }) => scan?.byShade.length).map(({ brightest }) => Math.round(brightest));
  const [limit, ...others] = new Set(limits);
  $("scale").hidden = limit === undefined || isAside();
  // Shades follow the root of an intensity.
  const numbers = others.length ? [0, "", "highest of each sensor"] : [0, limit < 4 ? "" : Math.round(limit / 4), limit];
  const [canvas, texts] = $("scale").children;
  [...texts.children].forEach((text, n) => put(text, String(numbers[n])));
  const { clientWidth: width, clientHeight: height } = canvas;
  if (width) {
    drawOn(canvas, () => shadeColours.forEach((shade, n) => {
      ink(shade, 1);
      pen.fillRect((n * width) / SHADES, 0, width / SHADES + 1, height);
    }), width, height);
  }
  for (const one of document.querySelectorAll("#layers [data-view]")) {
    one.hidden = one.dataset.view === "aside" ? !isAside() : !persons().length;
  }
}

function tellPlayer() {
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

/** Why the picture is empty, and what to do. */
function explain() {
  const [first] = shown();
  let trouble = robot.trouble ?? (robot.hub ? null : { what: "No hub", remedy: "scanhub run" });
  if (!isOpen) trouble = { what: "No connection to scanhub web", remedy: "It ended, or the network between is cut. This page tries again by itself." };
  else if (!isHeard()) trouble = { what: "No data from scanhub web", remedy: "Look at its terminal." };
  else if (!trouble && first?.status?.trouble && shown().every(({ scan }) => !scan)) {
    const { what, remedy } = first.status.trouble;
    trouble = { what: `${first.name}: ${what}`, remedy };
  }
  if (!trouble && isAside() && !pointsAside().length) {
    trouble = everySweep().some(({ sweep }) => sweep) ? { what: "Waiting for the next sweep", remedy: "" }
      : { what: $("swept").textContent, remedy: "Does the mount swing from turn to turn, and does scanhub tilt run?" };
  }
  const box = $("reason");
  box.hidden = !trouble;
  if (trouble) {
    put(box.firstElementChild, trouble.what);
    put(box.lastElementChild, trouble.remedy);
  }
}

const FIELDS = [
  ["rate", "hz", ({ hz }) => (hz === null ? "–" : `${hz.toFixed(1)} Hz`)],
  ["age p50 / p99", "age", ({ age_p50_ms: half, age_p99_ms: most }) => (half === null ? "–" : `${millis(half)} / ${millis(most)} ms`)],
  ["damaged on the line", "loss", ({ loss }) => percent(loss)],
  ["lost on the line; missed by this program", null, ({ lost_on_line: line, lost }) => `${line ?? "–"} / ${lost}`],
];
// Long values have no decimals, so that two fit in a line.
const millis = (ms) => ms.toFixed(ms < 100 ? 1 : 0);
const percent = (share) => `${(100 * share).toFixed(!share ? 0 : share < 0.1 ? 2 : 1)} %`;
const WELL = 0.001;

function make(tag, parent, name = "") {
  const element = document.createElement(tag);
  element.className = name;
  parent?.append(element);
  return element;
}

function makeCard(sensor) {
  const card = make("article", $("sensors"));
  const title = make("h2", card);
  sensor.card = { card, title: make("button", title), state: make("i", title), kind: make("div", card, "kind"), trouble: make("p", card, "trouble"), fields: [] };
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
  sensor.card.title.onclick = () => choose(sensor.space);
}

function tellSensors() {
  everySensor().forEach((sensor, n) => {
    const { status } = sensor;
    if (!status) return;
    if (!sensor.card) makeCard(sensor);
    const { card, title, state, kind, trouble, fields } = sensor.card;
    const isHere = isHeard() && robot.hub && sensor.session === session;
    const word = isHere ? status.state : "no status";
    const isLossy = status.loss > WELL;
    card.className = [word.replace(" ", "-"), isLossy ? "lossy" : "", shown().includes(sensor) ? "" : "off"].join(" ");
    put(title, `${n + 1}  ${sensor.name}`);
    press(title, only === sensor.space);
    put(state, word + (status.frozen ? ", frozen" : ""));
    put(kind, [status.family, status.model, status.port].filter(Boolean).join(" · "));
    const told = isHere && status.trouble;
    put(trouble, told ? [told.what, told.remedy].filter(Boolean).join(": ") : isLossy && isHere ? lossWords(status) : "");
    for (const { field, number, line, scale, series, text } of fields) {
      put(number, isHere ? text(status) : "–");
      field.className = series === "loss" && isLossy ? "amber" : "";
      if (line) put(scale, sparkline(line, sensor.history, series));
    }
  });
}

/** Returns the reason of the losses on a line, or the remedy. */
function lossWords({ loss, simulated, replayed }) {
  const line = simulated ? "simulated line" : replayed ? "recorded line" : "line";
  const remedy = replayed ? "" : simulated ? ": simulated faults, or this machine is too busy" : ": check cable, ground and rate";
  return `${percent(loss)} of its ${line} is damaged or lost${remedy}`;
}

/** Text of a sparkline's scale, which ends at `top`. */
const SCALES = { hz: (top) => `0–${top} Hz`, age: (top) => `p99, 0–${top} ms`, loss: (top) => `0–${fixed(100 * top, 0)} %` };

/** Returns the next round value above `value`. */
function roundUp(value) {
  const power = 10 ** floor(Math.log10(value));
  return power * [1, 2, 5, 10].find((step) => step * power >= value || step === 10);
}

/** Draws the last two minutes, from 0 on, because the middle of an empty curve does not mean trouble. Returns the scale as text. */
function sparkline(canvas, history, series) {
  const { clientWidth: width, clientHeight: height } = canvas;
  const now = performance.now();
  const top = roundUp(max(series === "loss" ? 0.01 : 1, ...history.map((one) => one[series])));
  const isWell = series === "loss" && history.every(({ loss }) => loss <= WELL);
  drawOn(canvas, () => {
    ink(colours.edge, 1);
    stroke([0, height - 0.5], [width, height - 0.5]);
    ink(isWell ? colours.soft : series === "loss" ? colours.slow : colours.accent, 1.5);
    pen.lineJoin = "round";
    stroke(...history.map((one) => [width - ((now - one.at) / HISTORY_MS) * width, height - 1 - (one[series] / top) * (height - 3)]));
  }, width, height);
  return `${SCALES[series](top)}, ${HISTORY_MS / 60_000} min`;
}
