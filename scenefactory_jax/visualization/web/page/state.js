// ---- state: what is shown, and the actions that change it

const PACES = [0.1, 0.25, 0.5, 1, 2, 4, 8];
const app = { world: null, index: 0, time: 0, playing: false, pace: 1, selected: null, follow: false, view: { x: 0, y: 0, scale: 4 } };
const dark = matchMedia("(prefers-color-scheme: dark)");
const colours = new Map(); // of the style sheet, until the scheme changes

const $ = (id) => document.getElementById(id);
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

function element(kind, properties = {}, ...children) {
  const made = Object.assign(document.createElement(kind), properties);
  made.append(...children);
  return made;
}

/** A number with a true minus sign; a value that rounds to zero has none. */
const number = (value, digits) => value.toFixed(digits).replace(/^-(?=0\.?0*$)/, "").replace("-", "−");

// ---- colours

/** A colour of the style sheet by name. */
function css(name) {
  if (!colours.has(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return colours.get(name);
}
const rgb = ([red, green, blue], alpha = 1) => `rgb(${red} ${green} ${blue} / ${alpha})`;
const lighten = (colour, fraction) => colour.map((part) => Math.round(part + fraction * (255 - part)));

/** In the dark scheme, dark colours are lightened. */
function inScheme(colour) {
  if (!dark.matches) return colour;
  const light = (0.3 * colour[0] + 0.6 * colour[1] + 0.1 * colour[2]) / 255;
  return lighten(colour, light < 0.02 ? 0.92 : 0.28 + 0.5 * Math.max(0, 0.45 - light));
}
const carColour = (slot) => inScheme(replay.colours[slot % replay.colours.length]);
const eventColour = (name) => inScheme(replay.marks[name]?.colour ?? [120, 120, 120]);
const eventLabel = (name) => replay.marks[name]?.label ?? name;

// ---- actions

/** The step whose numbers are shown. */
const now = () => Math.min(Math.floor(app.time + 1e-6), app.world.end);

function seek(time) {
  app.time = clamp(time, 0, app.world.end);
  refresh();
}

/** A jump by the user, which pauses. */
function goTo(step) {
  setPlaying(false);
  seek(step);
}
const nudge = (steps) => goTo(Math.round(app.time) + steps);

function setPlaying(playing) {
  if (playing && app.time >= app.world.end) app.time = 0;
  app.playing = playing;
  document.body.classList.toggle("playing", playing);
  $("play").setAttribute("aria-label", playing ? "Pause" : "Play");
}

function choosePace(pace) {
  app.pace = pace;
  $("pace").value = String(pace);
}

function select(slot) {
  app.selected = slot;
  setFollow(app.follow);
  showSelection();
  refresh();
}

function setFollow(follow) {
  app.follow = follow && app.selected !== null;
  $("follow").setAttribute("aria-pressed", String(app.follow));
  $("follow").disabled = app.selected === null;
  refresh();
}

/** The next car in the order of the list; null past either end. */
function neighbour(by) {
  const slots = [...app.world.bySlot.keys()];
  const at = slots.indexOf(app.selected);
  return (at < 0 ? slots.at(by > 0 ? 0 : -1) : slots[at + by]) ?? null;
}

/** The next car, around the list. */
const cycle = (by) => select(neighbour(by) ?? app.world.cars.at(by > 0 ? 0 : -1)?.slot ?? null);

function toEvent(by) {
  const { events } = app.world;
  const target = by > 0 ? events.find(({ step }) => step > now()) : events.findLast(({ step }) => step < now());
  if (target) showEvent(by > 0 ? target : events.find(({ step }) => step === target.step));
}

function showEvent(event) {
  select(event.car);
  goTo(event.step);
}

async function chooseWorld(index) {
  app.world = await openWorld(index);
  Object.assign(app, { index, time: 0 });
  $("world").value = String(index);
  showWorld();
  fit();
  select(app.world.cars[0]?.slot ?? null);
}
const cycleWorld = (by) => chooseWorld((app.index + replay.worlds.length + by) % replay.worlds.length);

// ---- frames

let stale = false;
const refresh = () => {
  stale = true;
};
let lastFrame = 0;

/** One frame: time passes while playing, and what changed is drawn. */
function tick(stamp) {
  if (app.playing) {
    seek(app.time + (((stamp - lastFrame) / 1000) * app.pace) / app.world.dt);
    if (app.time >= app.world.end) setPlaying(false);
  }
  lastFrame = stamp;
  if (stale) draw();
  stale = false;
  keepAddress(stamp);
  requestAnimationFrame(tick);
}

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

// ---- address: time, car and world in the page's address, `#t=12.3&car=4&world=2`

const ADDRESS_MS = 500; // minimum time between two changes: browsers limit their number
const address = { text: location.hash, at: 0 };

/** Shows what the address says: seconds, a car's number or `none`, a world's number; other values are ignored. */
async function openAddress() {
  const fields = new URLSearchParams(location.hash.slice(1));
  const value = (name) => (fields.get(name) ? Number(fields.get(name)) : NaN);
  const index = clamp(Number.isInteger(value("world")) ? value("world") - 1 : app.index, 0, replay.worlds.length - 1);
  if (!app.world || index !== app.index) await chooseWorld(index);
  if (fields.get("car") === "none") select(null);
  else if (app.world.bySlot.has(value("car"))) select(value("car"));
  if (Number.isFinite(value("t"))) goTo(Math.round((value("t") - app.world.start) / app.world.dt));
}

/** Writes time, car and world to the address without new entries in the browser's history; not in a frame, where it is not visible. */
function keepAddress(stamp) {
  if (window.parent !== window || stamp - address.at < ADDRESS_MS) return;
  const time = Number(seconds(app.world, now()).toFixed(2));
  const text = `#t=${time}&car=${app.selected ?? "none"}&world=${app.index + 1}`;
  if (text === address.text) return;
  Object.assign(address, { text, at: stamp });
  history.replaceState(null, "", location.href.split("#")[0] + text);
}
