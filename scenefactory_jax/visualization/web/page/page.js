// ---- page: panel, timeline, keys and buttons

const ASPHALTS = { AC: "asphalt concrete", SMA: "stone mastic asphalt", OGFC: "open-graded asphalt" };

function draw() {
  drawMap();
  showTime();
  showTally();
  for (const button of $("cars").children) {
    const car = app.world.bySlot.get(Number(button.dataset.car));
    button.classList.toggle("done", !within(car.spans, now()));
    button.setAttribute("aria-pressed", String(car.slot === app.selected));
  }
  if (app.selected !== null) {
    showFacts();
    showFailures();
    moveCursors();
  } else app.world.events.forEach((event, i) => $("events").children[i].firstChild.classList.toggle("future", event.step > now()));
}

function showWorld() {
  const { world } = app;
  preparePaths(world);
  $("scrub").max = String(world.end);
  $("cars").replaceChildren(...world.cars.map(carButton));
  $("events").replaceChildren(...world.events.map(eventRow));
  if (!world.events.length) $("events").append(element("li", { className: "quiet", textContent: "Nothing happens in this world." }));
  showLegend();
  drawTimeline();
}

function carButton({ slot }) {
  const button = element("button", { type: "button", textContent: String(slot) });
  button.setAttribute("aria-label", `Car ${slot}`);
  button.dataset.car = String(slot);
  button.style.setProperty("--colour", rgb(carColour(slot)));
  button.addEventListener("click", () => select(app.selected === slot ? null : slot));
  return button;
}

function eventRow(event) {
  const time = element("span", { className: "quiet", textContent: `${number(seconds(app.world, event.step), 2)} s` });
  const button = element("button", { type: "button" }, time, element("i"));
  button.append(element("span", { textContent: eventLabel(event.name) }), element("span", { textContent: `car ${event.car}` }));
  button.style.setProperty("--mark", rgb(eventColour(event.name)));
  button.addEventListener("click", () => showEvent(event));
  return element("li", {}, button);
}

function showTime() {
  const { world } = app;
  const text = `${number(seconds(world, now()), 2)} s`;
  $("time").replaceChildren(text, element("small", { textContent: ` / ${number(seconds(world, world.end), 1)} s` }));
  $("time").dataset.step = String(now());
  $("scrub").value = String(Math.round(app.time));
  $("scrub").setAttribute("aria-valuetext", text);
  const film = read(world, "film", 0, now());
  const surface = ASPHALTS[world.surface] ?? world.surface.toLowerCase();
  $("weather").textContent = `${surface}, ${film > 0 ? `${number(film, 2)} mm of water` : "dry"}`;
}

/** Events so far, by name; numerical errors only where there are some. */
function showTally() {
  const past = pastEvents(app.world, now());
  const entries = Object.keys(replay.marks).map((name) => {
    const count = past.filter((event) => event.name === name).length;
    const of = name === "goal_reached" ? ` of ${app.world.cars.length}` : "";
    const entry = element("span", { className: count ? "" : "none", textContent: `${eventLabel(name)} ${count}${of}` });
    entry.style.setProperty("--mark", rgb(eventColour(name)));
    return { entry, hidden: name === "numerical_error" && !count };
  });
  $("tally").replaceChildren(...entries.filter(({ hidden }) => !hidden).map(({ entry }) => entry));
}

function showSelection() {
  const car = app.world.bySlot.get(app.selected);
  $("car").hidden = !car;
  $("overview").hidden = Boolean(car);
  makeFailures();
  makeCharts();
  drawTimeline();
  $("cars").querySelector(`[data-car="${app.selected}"]`)?.scrollIntoView({ block: "nearest", inline: "nearest" });
  $("status").textContent = car ? `Car ${car.slot}, ${storyOf(car)}` : "No car selected";
}

/** A car's events so far, in words. */
function storyOf(car) {
  const past = pastEvents(app.world, now()).filter((event) => event.car === car.slot);
  const texts = past.map((event) => `${eventLabel(event.name)} at ${number(seconds(app.world, event.step), 1)} s`);
  return texts.join(", ") || (within(car.spans, now()) ? "driving" : "not on the road");
}

/** The numbers of the shown step; grey where they are those of the car's last step. */
function showFacts() {
  const car = app.world.bySlot.get(app.selected);
  const value = (name) => read(app.world, name, car.slot, now());
  $("car").classList.toggle("over", !within(car.spans, now()));
  $("car-title").replaceChildren(`Car ${car.slot}`, element("small", { textContent: storyOf(car) }));
  const facts = [
    ["speed", "speed", 3.6, 1, "km/h"],
    ["steer", "steer", 180 / Math.PI, 1, "°"],
    ["goal", "goal_distance", 1, 1, "m"],
    ["friction used", "friction_utilization", 100, 0, "%"],
  ]
    .filter(([, name]) => has(app.world, name))
    .map(([title, name, scale, digits, unit]) => [title, number(scale * value(name), digits), unit]);
  $("facts").replaceChildren(
    ...facts.map(([name]) => element("dt", { textContent: name })),
    ...facts.map(([, text, unit]) => element("dd", { textContent: text }, element("small", { textContent: unit }))),
  );
}

/** The timeline: bars of the world's and the selected car's time, and every event; those of the selected car are larger. */
function drawTimeline() {
  const { brush, width } = fitCanvas($("marks"));
  const across = (step) => 7 + (step / Math.max(app.world.end, 1)) * (width - 14);
  const bar = (first, last, colour) => {
    brush.fillStyle = colour;
    brush.beginPath();
    brush.roundRect(across(first), 27, Math.max(2, across(last) - across(first)), 4, 2);
    brush.fill();
  };
  bar(0, Math.max(app.world.end, 1), css("line"));
  const car = app.world.bySlot.get(app.selected);
  car?.spans.forEach(([first, last]) => bar(first, last, rgb(carColour(car.slot))));
  if (car) failuresOf(car).forEach(({ first, last }) => bar(first, last, css("fail")));
  for (const chosen of [false, true])
    for (const { name, step } of app.world.events.filter((event) => (event.car === app.selected) === chosen))
      drawGlyph(brush, name, across(step), 11, chosen ? 7 : 4, rgb(eventColour(name), chosen ? 1 : 0.8));
}

// ---- input

const changePace = (by) => choosePace(PACES[clamp(PACES.indexOf(app.pace) + by, 0, PACES.length - 1)]);
const stepsOf = (event) => (event.shiftKey ? Math.round(1 / app.world.dt) : 1);
const KEYS = {
  " ": () => setPlaying(!app.playing),
  ArrowLeft: (event) => nudge(-stepsOf(event)),
  ArrowRight: (event) => nudge(stepsOf(event)),
  ArrowUp: () => changePace(1),
  ArrowDown: () => changePace(-1),
  Home: () => seek(0),
  End: () => seek(app.world.end),
  e: () => toEvent(1),
  E: () => toEvent(-1),
  m: () => toFailure(1),
  M: () => toFailure(-1),
  n: () => cycle(1),
  p: () => cycle(-1),
  f: fit,
  c: toggleFollow,
  w: () => cycleWorld(1),
  W: () => cycleWorld(-1),
  "+": () => zoom(1.25),
  "=": () => zoom(1.25),
  "-": () => zoom(0.8),
  "?": () => $("keys").showModal(),
  Escape: () => select(null),
};
const BUTTONS = { play: " ", fit: "f", follow: "c", "zoom-in": "+", "zoom-out": "-", help: "?" }; // id -> key

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || $("keys").open || event.target.tagName === "SELECT") return;
  if (event.target.tagName === "BUTTON" && event.key === " ") return; // it presses the button
  const action = /^\d$/.test(event.key) ? () => selectByDigit(event.key) : KEYS[event.key];
  if (!action) return;
  event.preventDefault();
  action(event);
}

let typed = { digits: "", at: 0 };

/** Selects a car by its number; a second digit within 0.7 s makes a longer number, if there is such a car. */
function selectByDigit(digit) {
  const stamp = performance.now();
  const digits = stamp - typed.at < 700 ? typed.digits + digit : digit;
  typed = { digits: app.world.bySlot.has(Number(digits)) ? digits : digit, at: stamp };
  if (app.world.bySlot.has(Number(typed.digits))) select(Number(typed.digits));
}

/** On the map Tab selects the next car; after the last one it moves the focus on. */
function onMapKey(event) {
  if (event.key !== "Tab" || event.ctrlKey || event.altKey) return;
  const slot = neighbour(event.shiftKey ? -1 : 1);
  if (slot === null) return;
  event.preventDefault();
  select(slot);
}

function listen() {
  const on = (target, handlers, options) =>
    Object.entries(handlers).forEach(([type, handler]) => target.addEventListener(type, handler, options));
  on(document, { keydown: onKey });
  on(canvas, { keydown: onMapKey, dblclick: fit, pointerdown: onDown, pointermove: onMove, pointerup: onUp, pointercancel: onUp });
  on(canvas, { wheel: onWheel }, { passive: false });
  for (const [id, key] of Object.entries(BUTTONS)) on($(id), { click: () => KEYS[key]() });
  on($("back"), { click: () => nudge(-1) });
  on($("forward"), { click: () => nudge(1) });
  on($("scrub"), { input: () => goTo(Number($("scrub").value)) });
  on($("pace"), { change: () => choosePace(Number($("pace").value)) });
  on($("world"), { change: () => chooseWorld(Number($("world").value)) });
  on(window, { hashchange: openAddress });
  on(dark, { change: showScheme });
  for (const id of ["stage", "panel"]) new ResizeObserver(redraw).observe($(id));
}

function showScheme() {
  colours.clear();
  showWorld();
  showSelection();
  refresh();
}

function redraw() {
  screen = fitCanvas(canvas);
  drawTimeline();
  drawCharts();
  refresh();
}

async function start() {
  const option = (text, value, selected) => element("option", { value: String(value), textContent: text, selected });
  $("world").append(...replay.worlds.map((world, i) => option(`${i + 1}. ${world.name}`, i, i === 0)));
  $("pace").append(...PACES.map((pace) => option(`${pace} ×`, pace, pace === 1)));
  screen = fitCanvas(canvas);
  try {
    await openAddress();
  } catch (error) {
    const text = `This replay cannot be read: ${error.message}`;
    document.querySelector("main").replaceChildren(element("p", { className: "error", textContent: text }));
    throw error;
  }
  listen();
  requestAnimationFrame(tick);
}

start();
