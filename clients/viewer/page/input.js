// Input of the user: buttons, keys, mouse and touch. The end of this file starts the page.

function selectSensor(space) {
  shownSpace = space === shownSpace ? null : space;
  isFitDue = true;
  requestDraw();
  showSensors();
}

function zoom(factor, px = middle.x, py = middle.y) {
  const [x, y] = toRobot(px, py);
  stopFitting();
  view.scale = min(4000, max(1.5, view.scale * factor));
  const [nx, ny] = toRobot(px, py);
  view.x += x - nx;
  view.y += y - ny;
  requestDraw();
}

function pan(dx, dy) {
  const [x, y] = toRobot(middle.x - dx, middle.y - dy);
  stopFitting();
  [view.x, view.y] = [x, y].map((value) => max(-200, min(200, value)));
  requestDraw();
}

function turn(angle) {
  view.turn += angle;
  isFitDue = true;
  updateView();
  requestDraw();
}

function stopFitting() {
  Object.assign(view, { fits: false, goal: null });
  press(buttonOf("fit"), false);
}

const buttonOf = (name) => document.querySelector(`[data-do=${name}]`);
const press = (button, isOn) => { button.ariaPressed = isOn; };

const actions = {
  fit: () => {
    Object.assign(view, { fits: true, isFitted: false, turn: 0 });
    updateView();
    press(buttonOf("fit"), true);
    fit();
  },
  side: () => {
    view = views[isSideView() ? 0 : 1];
    tape = null;
    isFitDue = true;
    updateView();
    press(buttonOf("side"), isSideView());
    press(buttonOf("fit"), view.fits);
    map.ariaLabel = map.ariaLabel.replace(/above|the side/, isSideView() ? "the side" : "above");
    subscribe();
    updateTexts();
  },
  in: () => zoom(1.25),
  out: () => zoom(0.8),
  turn: () => turn(PI / 12),
  tape: () => {
    isTape = !isTape;
    tape = null;
    press(buttonOf("tape"), isTape);
  },
  hold: () => {
    const held = heldMessages;
    isHeldMap = Boolean(robot.map);
    heldMessages = held ? null : new Map();
    if (held && clearOnRelease) clearPicture();
    dropOtherRuns();
    for (const [topic, [buffer, offset]] of held ?? []) show(topic, buffer, offset);
    press(buttonOf("hold"), Boolean(heldMessages));
    updateTexts();
  },
  layers: () => press(buttonOf("layers"), $("layers").classList.toggle("open")),
  theme: () => {
    document.documentElement.style.colorScheme = isDark ? "light" : "dark";
    readColors();
  },
  help: () => ($("help").open ? $("help").close() : $("help").showModal()),
};

function runAction(name) {
  actions[name]();
  requestDraw();
}

for (const button of document.querySelectorAll("nav button")) button.onclick = () => runAction(button.dataset.do);
for (const [layer, [key, name]] of Object.entries(LAYERS)) {
  const button = make("button", $("layers"));
  button.dataset.key = key;
  button.ariaLabel = name;
  button.setAttribute("aria-keyshortcuts", key);
  make("i", button, layer);
  make("span", button).textContent = name;
  make("kbd", button).textContent = key;
  const mark = () => press(button, layers[layer]);
  button.onclick = () => {
    layers[layer] = !layers[layer];
    try { sessionStorage.setItem("layers", JSON.stringify(layers)); } catch { /* The browser stores nothing. */ }
    if (layer === "lines") {
      [walls, corners] = [[], []];
      subscribe();
    }
    mark();
    requestDraw();
  };
  mark();
}

const scaleBox = make("div");
scaleBox.id = "scale";
make("canvas", scaleBox).setAttribute("aria-hidden", "true");
const scaleTexts = make("small", scaleBox);
for (let n = 0; n < 3; n++) make("span", scaleTexts);
document.querySelector("[data-key=i]").after(scaleBox);

// Entries of the legend for objects that are not in the list of layers: view, kind and text.
const LEGEND = [["above", "people", "Person. Numbers count all tracks since the tracker started"],
  ["aside", "unknown", "Background not known yet"], ["aside", "behind", "Behind the background"]];
for (const [view, kind, text] of LEGEND) {
  const line = make("p", $("layers"));
  line.dataset.view = view;
  make("i", line, kind);
  make("span", line).textContent = text;
}

for (const button of document.querySelectorAll("#player button")) {
  button.onclick = () => {
    if (isOpen) socket.send(JSON.stringify({ op: "scanhub.player", order: button.dataset.order }));
  };
}

addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || $("help").open) return;
  if (event.target.tagName === "BUTTON" && [" ", "Enter"].includes(event.key)) return;
  const moves = { ArrowLeft: [48, 0], ArrowRight: [-48, 0], ArrowUp: [0, 48], ArrowDown: [0, -48] };
  if (moves[event.key]) pan(...moves[event.key]);
  else if (event.key === "=") runAction("in");
  else if (event.key === "[") turn(-PI / 12);
  else if (event.key === "0") selectSensor(shownSpace);
  else if (/^[1-9]$/.test(event.key)) {
    const sensor = allSensors()[Number(event.key) - 1];
    if (sensor) selectSensor(sensor.space);
  } else {
    const button = document.querySelector(`[data-key="${CSS.escape(event.key)}"]`);
    if (!button || button.closest("[hidden]")) return;
    button.click();
  }
  event.preventDefault();
});

// Pointers (fingers or the mouse) that are pressed. One pointer moves the view, and two pointers zoom and turn it.
const fingers = new Map();
const pointOf = (event) => [event.clientX, event.clientY];

map.onpointerdown = (event) => {
  map.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, pointOf(event));
  const at = toRobot(...pointOf(event));
  tape = (isTape || event.shiftKey) && fingers.size === 1 ? { from: at, to: at } : null;
  requestDraw();
};

map.onpointermove = (event) => {
  pointer = pointOf(event);
  const previous = fingers.get(event.pointerId);
  if (previous) {
    const from = (point) => [pointer[0] - point[0], pointer[1] - point[1]];
    const other = [...fingers].find(([id]) => id !== event.pointerId)?.[1];
    if (tape && fingers.size === 1) tape.to = toRobot(...pointer);
    else if (other) {
      const [before, after] = [[previous[0] - other[0], previous[1] - other[1]], from(other)];
      turn(atan2(after[1], after[0]) - atan2(before[1], before[0]));
      zoom(hypot(...after) / max(1, hypot(...before)), ...other);
    } else if (event.altKey) turn(from(previous)[0] / 200);
    else pan(...from(previous));
    fingers.set(event.pointerId, pointer);
  }
  requestDraw();
};

map.onpointerup = map.onpointercancel = (event) => {
  fingers.delete(event.pointerId);
  if (event.pointerType === "touch" && !fingers.size) pointer = pointOf(event);
};
map.onpointerleave = () => {
  pointer = null;
  requestDraw();
};
map.addEventListener("wheel", (event) => {
  event.preventDefault();
  zoom(Math.exp(-event.deltaY * (event.ctrlKey ? 0.01 : 0.0015)), event.clientX, event.clientY);
}, { passive: false });

addEventListener("resize", resize);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  readColors();
  requestDraw();
});

// Figures for tests and for users of the browser's console.

Object.defineProperty(window, "scanhub", {
  get: () => ({
    frames,
    scans: Object.fromEntries(allSensors().map(({ name, scans }) => [name, scans])),
    ...drawn,
    people: allPeople(),
    aside: isSideView(),
    sweeps: allSweeps().map(({ name, sweep, obstacles, points }) => ({ name, ...sweep, obstacles, points: points?.map((xyz) => xyz.length / 3) })),
    shown: () => ages,
    points: (name) => allSensors().filter((one) => one.name === name && one.scan && poseOf(one)).flatMap((one) =>
      [...one.scan.points].flatMap((x, i, xs) => (i % 2 ? [] : inFrame(poseOf(one), x, xs[i + 1])))),
    screen: toScreen,
    place: toRobot,
    view: { x: view.x, y: view.y, scale: view.scale, turn: view.turn },
    verdict: verdict(),
    connected: isOpen,
    player,
    reason: $("reason").hidden ? null : $("reason").innerText,
    sensors: allSensors().map(({ status }) => status).filter(Boolean),
  }),
});

readColors();
resize();
connect();
updateTexts();
setInterval(updateTexts, 100);
setInterval(showSensors, 500);
