// ---- view: the part of the world that the map shows

const canvas = $("map");
let screen = { width: 1, height: 1 };

function toScreen(x, y) {
  const { scale } = app.view;
  return [screen.width / 2 + (x - app.view.x) * scale, screen.height / 2 - (y - app.view.y) * scale];
}

/** Shows all trajectories and goals. */
function fit() {
  const points = [];
  for (const car of app.world.cars) {
    car.goals.forEach(([, x, y]) => points.push([x, y]));
    for (const [first, last] of car.spans)
      for (let step = first; step <= last; step += 5) points.push(["x", "y"].map((name) => read(app.world, name, car.slot, step)));
  }
  if (!points.length) points.push([0, 0]);
  const bounds = [0, 1].map((axis) => [Math.min, Math.max].map((bound) => bound(...points.map((point) => point[axis]))));
  const [x, y] = bounds.map(([low, high]) => (low + high) / 2);
  const [wide, high] = bounds.map(([low, high]) => Math.max(high - low + 24, 40)); // a margin of 12 m
  app.view = { x, y, scale: clamp(Math.min(screen.width / wide, screen.height / high), 0.3, 60) };
  setFollow(false);
}

/** Zooms about a point of the screen, by default its centre. */
function zoom(factor, left = screen.width / 2, top = screen.height / 2) {
  const scale = clamp(app.view.scale * factor, 0.3, 120);
  if (!app.follow) {
    const shift = 1 / app.view.scale - 1 / scale;
    app.view.x += (left - screen.width / 2) * shift;
    app.view.y -= (top - screen.height / 2) * shift;
  }
  app.view.scale = scale;
  refresh();
}

function toggleFollow() {
  setFollow(!app.follow);
  if (app.follow) app.view.scale = Math.max(app.view.scale, 9);
}

// ---- pointers: a drag moves the map, two fingers zoom, a click selects a car

const pointers = new Map();
let pressed = null; // where a click began, until the pointer moves

function onDown(event) {
  canvas.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
  pressed = pointers.size === 1 ? [event.offsetX, event.offsetY] : null;
}

const centreOf = (points) => [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
const distanceOf = ([[a, b], [c, d]]) => Math.hypot(a - c, b - d);

function onMove(event) {
  if (!pointers.has(event.pointerId)) return;
  const before = [...pointers.values()];
  pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
  const after = [...pointers.values()];
  if (pressed && distanceOf([pressed, [event.offsetX, event.offsetY]]) > 5) pressed = null;
  if (pressed) return;
  const [from, to] = [centreOf(before), centreOf(after)];
  if (!app.follow) {
    app.view.x -= (to[0] - from[0]) / app.view.scale;
    app.view.y += (to[1] - from[1]) / app.view.scale;
  } else if (after.length === 1) setFollow(false);
  if (after.length === 2) zoom(distanceOf(after) / Math.max(distanceOf(before), 1), ...to);
  refresh();
}

function onUp(event) {
  const slot = pressed && event.type === "pointerup" ? carAt(...pressed) : null;
  if (slot !== null) select(slot);
  pointers.delete(event.pointerId);
  pressed = null;
}

function onWheel(event) {
  event.preventDefault();
  zoom(Math.exp(-clamp(event.deltaY, -240, 240) * 0.0022), event.offsetX, event.offsetY);
}

/** The nearest car within 16 pixels of a point of the screen, or null. */
function carAt(left, top) {
  let best = [16, null];
  for (const car of app.world.cars) {
    if (opacity(app.world, car, app.time) <= 0) continue;
    const { x, y } = pose(app.world, "", car.slot, app.time);
    const distance = Math.max(0, distanceOf([toScreen(x, y), [left, top]]) - 0.5 * car.size[1] * app.view.scale);
    if (distance < best[0]) best = [distance, car.slot];
  }
  return best[1];
}
