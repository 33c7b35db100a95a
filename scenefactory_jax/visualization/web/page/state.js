// ---- state: all that the page remembers, and the ways to change it

const PACES = [0.1, 0.25, 0.5, 1, 2, 4, 8];
const TRAIL_S = 3;
const app = { world: null, index: 0, time: 0, playing: false, pace: 1, selected: null, follow: false, view: { x: 0, y: 0, scale: 4 } };
const $ = (id) => document.getElementById(id);
const dark = matchMedia("(prefers-color-scheme: dark)");
const colours = new Map(); // of the style sheet, as long as the scheme stays

/** A colour of the style sheet by name. */
function css(name) {
  if (!colours.has(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return colours.get(name);
}
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
const rgb = ([red, green, blue], alpha = 1) => `rgb(${red} ${green} ${blue} / ${alpha})`;
const lighten = (colour, share) => colour.map((part) => Math.round(part + share * (255 - part)));

/** The step whose numbers count now. */
const now = () => Math.min(Math.floor(app.time + 1e-6), app.world.end);

/** A colour as the scheme needs it: in the dark the deep ones need light. */
function inScheme(colour) {
  if (!dark.matches) return colour;
  const light = (0.3 * colour[0] + 0.6 * colour[1] + 0.1 * colour[2]) / 255;
  return lighten(colour, light < 0.02 ? 0.92 : 0.28 + 0.5 * Math.max(0, 0.45 - light));
}
const colourOf = (slot) => inScheme(replay.colours[slot % replay.colours.length]);
const colourOfMark = (name) => inScheme(replay.marks[name]?.colour ?? [120, 120, 120]);

function seek(time) {
  app.time = clamp(time, 0, app.world.end);
  refresh();
}

function nudge(steps) {
  pause();
  seek(Math.round(app.time) + steps);
}

function play() {
  if (app.time >= app.world.end) app.time = 0;
  app.playing = true;
  last = null;
  showPlaying();
}

function pause() {
  app.playing = false;
  showPlaying();
}

function choosePace(pace) {
  app.pace = pace;
  $("pace").value = String(pace);
}

function select(slot) {
  app.selected = slot;
  if (slot === null) app.follow = false;
  showSelection();
  refresh();
}

/** The next car in the order of the list; null past either end. */
function neighbour(by) {
  const slots = app.world.cars.map((car) => car.slot);
  const place = slots.indexOf(app.selected);
  return slots[place < 0 ? (by > 0 ? 0 : slots.length - 1) : place + by] ?? null;
}

/** The next car, around the list. */
function cycle(by) {
  const slots = app.world.cars.map((car) => car.slot);
  select(neighbour(by) ?? slots[by > 0 ? 0 : slots.length - 1] ?? null);
}

function toEvent(by) {
  const steps = app.world.events.map((event) => event.step);
  const target = by > 0 ? steps.find((step) => step > now()) : steps.findLast((step) => step < now());
  if (target === undefined) return;
  pause();
  const event = app.world.events.find((one) => one.step === target);
  select(event.car);
  seek(target);
}

async function chooseWorld(index) {
  app.world = await openWorld(index);
  app.index = index;
  app.time = 0;
  $("world").value = String(index);
  showWorld();
  fit();
  select(app.world.cars[0]?.slot ?? null);
}

let last = null;

/** One frame: time passes while playing, and what changed is drawn. */
function tick(stamp) {
  if (app.playing && app.world) {
    if (last !== null) app.time += (((stamp - last) / 1000) * app.pace) / app.world.dt;
    if (app.time >= app.world.end) {
      app.time = app.world.end;
      pause();
    }
    last = stamp;
    refresh();
  }
  if (stale && app.world) {
    stale = false;
    draw();
  }
  if (app.world) keepAddress(stamp);
  requestAnimationFrame(tick);
}

let stale = false;
const refresh = () => {
  stale = true;
};

/** A canvas as large as the element around it, empty, with a brush that counts in CSS pixels. */
function fitCanvas(picture) {
  const ratio = devicePixelRatio || 1;
  const { width, height } = picture.parentElement.getBoundingClientRect();
  picture.width = Math.max(1, Math.round(width * ratio));
  picture.height = Math.max(1, Math.round(height * ratio));
  const brush = picture.getContext("2d");
  brush.setTransform(ratio, 0, 0, ratio, 0, 0);
  return { brush, width, height };
}
