// ---- page: what is around map and charts, and what people do to it

const SURFACES = {
  AC: "asphalt concrete",
  SMA: "stone mastic asphalt",
  OGFC: "open-graded asphalt",
  GRAVEL: "gravel",
  SNOW: "snow",
  ICE: "ice",
};

function draw() {
  drawMap();
  showTime();
  showTally();
  showCars();
  if (app.selected === null) showEvents();
  else {
    showFacts();
    moveCursors();
  }
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
  showPlaying();
}

function carButton({ slot }) {
  const button = element("button", { type: "button", textContent: String(slot) });
  button.dataset.car = String(slot);
  button.setAttribute("aria-label", `Car ${slot}`);
  button.style.setProperty("--own", rgb(colourOf(slot)));
  button.addEventListener("click", () => select(app.selected === slot ? null : slot));
  return button;
}

function eventRow(event) {
  const row = element("li");
  const button = element("button", { type: "button" });
  button.style.setProperty("--mark", rgb(colourOfMark(event.name)));
  button.append(
    element("span", { className: "quiet", textContent: `${number(seconds(app.world, event.step), 2)} s` }),
    element("i"),
    element("span", { textContent: replay.marks[event.name]?.label ?? event.name }),
    element("span", { textContent: `car ${event.car}` }),
  );
  button.addEventListener("click", () => {
    pause();
    select(event.car);
    seek(event.step);
  });
  row.append(button);
  return row;
}

function showTime() {
  const { world } = app;
  const text = `${number(seconds(world, now()), 2)} s`;
  $("time").firstChild.textContent = text;
  $("time").lastElementChild.textContent = ` / ${number(seconds(world, world.end), 1)} s`;
  $("time").dataset.step = String(now());
  $("scrub").value = String(Math.round(app.time));
  $("scrub").setAttribute("aria-valuetext", text);
  const film = read(world, "film", 0, now());
  $("weather").textContent = `${SURFACES[world.surface] ?? world.surface}, ${film > 0 ? `${number(film, 2)} mm of water` : "dry"}`;
}

function showTally() {
  const counts = {};
  for (const { name } of counted(app.world, now())) counts[name] = (counts[name] ?? 0) + 1;
  const names = Object.keys(replay.marks).filter((name) => name !== "numerical_error" || counts[name]);
  const text = names.map((name) => `${name}:${counts[name] ?? 0}`).join();
  if ($("tally").dataset.text === `${app.index}:${text}`) return;
  $("tally").dataset.text = `${app.index}:${text}`;
  $("tally").replaceChildren(
    ...names.map((name) => {
      const entry = element("span", { className: counts[name] ? "" : "none" });
      const of = name === "goal_reached" ? ` of ${app.world.cars.length}` : "";
      entry.textContent = `${replay.marks[name].label} ${counts[name] ?? 0}${of}`;
      entry.style.setProperty("--mark", rgb(colourOfMark(name)));
      return entry;
    }),
  );
}

function showCars() {
  for (const button of $("cars").children) {
    const car = app.world.bySlot.get(Number(button.dataset.car));
    button.classList.toggle("done", !within(car.spans, now()));
    button.setAttribute("aria-pressed", String(car.slot === app.selected));
  }
}

function showEvents() {
  app.world.events.forEach((event, i) => $("events").children[i].firstChild.classList.toggle("future", event.step > now()));
}

function showSelection() {
  const chosen = app.selected !== null;
  $("car").hidden = !chosen;
  $("overview").hidden = chosen;
  makeCharts();
  drawTimeline();
  showFollow();
  $("cars").querySelector(`[data-car="${app.selected}"]`)?.scrollIntoView({ block: "nearest", inline: "nearest" });
  say(chosen ? `Car ${app.selected}, ${storyOf(app.world.bySlot.get(app.selected))}` : "No car selected");
}

/** A car's doings so far, in words. */
function storyOf(car) {
  const past = counted(app.world, now()).filter((event) => event.car === car.slot);
  const told = past.map((event) => `${replay.marks[event.name]?.label ?? event.name} at ${number(seconds(app.world, event.step), 1)} s`);
  return told.join(", ") || (within(car.spans, now()) ? "driving" : "not on the road");
}

/** The numbers of now; grey where they are those of the car's last step. */
function showFacts() {
  const car = app.world.bySlot.get(app.selected);
  const step = now();
  const get = (name) => read(app.world, name, car.slot, step);
  $("car").classList.toggle("over", !within(car.spans, step));
  $("who").replaceChildren(`Car ${car.slot}`, element("small", { textContent: storyOf(car) }));
  const facts = [
    ["speed", number(3.6 * get("speed"), 1), "km/h"],
    ["steer", number((get("steer") * 180) / Math.PI, 1), "°"],
    ["goal", number(get("goal_distance"), 1), "m"],
    ["friction used", number(100 * get("friction_utilization"), 0), "%"],
  ];
  $("facts").replaceChildren(
    ...facts.map(([name]) => element("dt", { textContent: name })),
    ...facts.map(([, value, unit]) => {
      const entry = element("dd", { textContent: value });
      entry.append(element("small", { textContent: unit }));
      return entry;
    }),
  );
}

function showPlaying() {
  document.body.classList.toggle("playing", app.playing);
  $("play").setAttribute("aria-label", app.playing ? "Pause" : "Play");
}

function showFollow() {
  $("follow").setAttribute("aria-pressed", String(app.follow));
  $("follow").disabled = app.selected === null;
}

function say(text) {
  $("say").textContent = text;
}

/** The timeline: a bar of the world's time, seconds, and every event; those of the selected car are larger. */
function drawTimeline() {
  const { brush, width, height } = fitCanvas($("marks"));
  const across = (step) => 7 + (step / Math.max(app.world.end, 1)) * (width - 14);
  const middle = 29;
  brush.fillStyle = css("line");
  brush.beginPath();
  brush.roundRect(7, middle - 2, width - 14, 4, 2);
  brush.fill();
  drawSpans(brush, across, middle);
  brush.font = "10px system-ui, sans-serif";
  for (const event of app.world.events)
    if (event.car !== app.selected) glyph(brush, event.name, across(event.step), 11, 4, rgb(colourOfMark(event.name), 0.8));
  for (const event of app.world.events)
    if (event.car === app.selected) glyph(brush, event.name, across(event.step), 11, 7, rgb(colourOfMark(event.name)));
}

/** When the selected car drives. */
function drawSpans(brush, across, middle) {
  const car = app.world.bySlot.get(app.selected);
  if (!car) return;
  brush.fillStyle = rgb(colourOf(car.slot));
  for (const [first, end] of car.spans) {
    brush.beginPath();
    brush.roundRect(across(first), middle - 2, Math.max(2, across(end) - across(first)), 4, 2);
    brush.fill();
  }
}

// ---- hands

const KEYS = {
  " ": () => (app.playing ? pause() : play()),
  ArrowLeft: (event) => nudge(event.shiftKey ? -Math.round(1 / app.world.dt) : -1),
  ArrowRight: (event) => nudge(event.shiftKey ? Math.round(1 / app.world.dt) : 1),
  ArrowUp: () => choosePace(PACES[Math.min(PACES.indexOf(app.pace) + 1, PACES.length - 1)]),
  ArrowDown: () => choosePace(PACES[Math.max(PACES.indexOf(app.pace) - 1, 0)]),
  Home: () => seek(0),
  End: () => seek(app.world.end),
  e: () => toEvent(1),
  E: () => toEvent(-1),
  n: () => cycle(1),
  p: () => cycle(-1),
  f: () => fit(),
  c: () => follow(!app.follow),
  w: () => chooseWorld((app.index + 1) % replay.worlds.length),
  W: () => chooseWorld((app.index + replay.worlds.length - 1) % replay.worlds.length),
  "+": () => zoom(1.25),
  "=": () => zoom(1.25),
  "-": () => zoom(0.8),
  "?": () => $("keys").showModal(),
  Escape: () => select(null),
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || $("keys").open || event.target.tagName === "SELECT") return;
  if (event.target.tagName === "BUTTON" && event.key === " ") return; // it presses the button
  const action = /^\d$/.test(event.key) ? () => chooseByNumber(event.key) : KEYS[event.key];
  if (!action || !app.world) return;
  event.preventDefault();
  action(event);
}

let typed = { digits: "", at: 0 };

/** The car of a number; a second digit soon after the first makes a longer number, where there is such a car. */
function chooseByNumber(digit) {
  const stamp = performance.now();
  const digits = stamp - typed.at < 700 ? typed.digits + digit : digit;
  typed = { digits: app.world.bySlot.has(Number(digits)) ? digits : digit, at: stamp };
  if (app.world.bySlot.has(Number(typed.digits))) select(Number(typed.digits));
}

/** On the map Tab goes from car to car, and on to the page's next element behind the last one. */
function onMapKey(event) {
  if (event.key !== "Tab" || event.ctrlKey || event.altKey || !app.world) return;
  const slot = neighbour(event.shiftKey ? -1 : 1);
  if (slot === null) return;
  event.preventDefault();
  select(slot);
}

const fingers = new Map();
let pressed = null;

function onDown(event) {
  canvas.setPointerCapture(event.pointerId);
  fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
  pressed = fingers.size === 1 ? [event.offsetX, event.offsetY] : null;
}

function onMove(event) {
  if (!fingers.has(event.pointerId)) return;
  const before = [...fingers.values()];
  fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
  const after = [...fingers.values()];
  const middle = (points) => [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
  const [from, to] = [middle(before), middle(after)];
  if (pressed && Math.hypot(event.offsetX - pressed[0], event.offsetY - pressed[1]) > 5) pressed = null;
  if (pressed) return;
  if (!app.follow) {
    app.view.x -= (to[0] - from[0]) / app.view.scale;
    app.view.y += (to[1] - from[1]) / app.view.scale;
  } else if (after.length === 1) follow(false);
  if (after.length === 2) zoom(apart(after) / Math.max(apart(before), 1), ...to);
  refresh();
}

const apart = ([[a, b], [c, d]]) => Math.hypot(a - c, b - d);

function onUp(event) {
  if (pressed && fingers.size === 1 && event.type === "pointerup") {
    const slot = carAt(...pressed);
    if (slot !== null) select(slot);
  }
  fingers.delete(event.pointerId);
  pressed = null;
}

function onWheel(event) {
  event.preventDefault();
  zoom(Math.exp(-clamp(event.deltaY, -240, 240) * 0.0022), event.offsetX, event.offsetY);
}

function listen() {
  document.addEventListener("keydown", onKey);
  canvas.addEventListener("keydown", onMapKey);
  for (const [type, action] of Object.entries({ pointerdown: onDown, pointermove: onMove, pointerup: onUp, pointercancel: onUp }))
    canvas.addEventListener(type, action);
  canvas.addEventListener("wheel", onWheel, { passive: false });
  canvas.addEventListener("dblclick", fit);
  const clicks = {
    play: KEYS[" "],
    back: () => nudge(-1),
    on: () => nudge(1),
    fit,
    closer: KEYS["+"],
    farther: KEYS["-"],
    help: KEYS["?"],
    follow: () => follow(!app.follow),
  };
  for (const [id, action] of Object.entries(clicks)) $(id).addEventListener("click", action);
  $("scrub").addEventListener("input", () => {
    pause();
    seek(Number($("scrub").value));
  });
  $("pace").addEventListener("change", () => choosePace(Number($("pace").value)));
  $("world").addEventListener("change", () => chooseWorld(Number($("world").value)));
  dark.addEventListener("change", () => {
    colours.clear();
    if (app.world) showWorld();
    redraw();
  });
  window.addEventListener("hashchange", openAddress);
  new ResizeObserver(redraw).observe($("stage"));
  new ResizeObserver(redraw).observe($("panel"));
}

function redraw() {
  resize();
  if (!app.world) return;
  drawTimeline();
  drawCharts();
}

async function start() {
  $("time").append("", element("small"));
  $("world").append(...replay.worlds.map((world, i) => element("option", { value: String(i), textContent: `${i + 1}. ${world.name}` })));
  $("pace").append(...PACES.map((pace) => element("option", { value: String(pace), textContent: `${pace} ×`, selected: pace === 1 })));
  listen();
  resize();
  try {
    await openAddress();
  } catch (error) {
    document
      .querySelector("main")
      .replaceChildren(element("p", { className: "error", textContent: `This replay cannot be read: ${error.message}` }));
    throw error;
  }
  requestAnimationFrame(tick);
}

start();
