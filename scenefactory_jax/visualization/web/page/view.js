// ---- view: what of the world does not move, and the window on it

const canvas = $("map");
const pen = canvas.getContext("2d");
let paths = {};

/** Paths of everything that does not move, in metres, made once a world. */
function preparePaths(world) {
  paths = {};
  for (const [name, lines] of Object.entries(world.road)) {
    paths[name] = new Path2D();
    lines.forEach((line) => addLine(paths[name], line));
  }
  paths.casing = paths.lane;
  paths.centre = paths.lane;
  paths.zebras = world.road.crosswalk.filter((line) => line.length >= 8).map(zebra);
  paths.patches = world.patches.map((patch) => {
    const path = new Path2D();
    patch.pieces.forEach((piece) => {
      addLine(path, oneWay(piece).flat());
      path.closePath();
    });
    return { path, colour: patch.colour };
  });
}

function addLine(path, line) {
  for (let i = 0; i < line.length; i += 2) path[i ? "lineTo" : "moveTo"](line[i], line[i + 1]);
}

/** A polygon's points counter-clockwise, so that pieces that overlap fill as one. */
function oneWay(points) {
  const area = points.reduce((sum, [x, y], i) => {
    const [u, v] = points[(i + 1) % points.length];
    return sum + x * v - u * y;
  }, 0);
  return area < 0 ? [...points].reverse() : points;
}

/** A crosswalk: its outline, and the line along its longest side's direction on which the stripes are dashes. */
function zebra(line) {
  const outline = new Path2D();
  addLine(outline, line);
  outline.closePath();
  let best = [0, 1, 0];
  let [x, y, points] = [0, 0, line.length / 2];
  for (let i = 0; i < line.length; i += 2) {
    x += line[i] / points;
    y += line[i + 1] / points;
    const j = (i + 2) % line.length;
    const [dx, dy] = [line[j] - line[i], line[j + 1] - line[i + 1]];
    const length = Math.hypot(dx, dy);
    if (length > best[0]) best = [length, dx / length, dy / length];
  }
  const axis = new Path2D();
  addLine(axis, [x - 40 * best[1], y - 40 * best[2], x + 40 * best[1], y + 40 * best[2]]);
  return { outline, axis };
}

// ---- the window

function resize() {
  const ratio = devicePixelRatio || 1;
  const { width, height } = canvas.getBoundingClientRect();
  canvas.width = Math.max(1, Math.round(width * ratio));
  canvas.height = Math.max(1, Math.round(height * ratio));
  refresh();
}

const size = () => [canvas.width / (devicePixelRatio || 1), canvas.height / (devicePixelRatio || 1)];
function toScreen(x, y) {
  const [width, height] = size();
  return [width / 2 + (x - app.view.x) * app.view.scale, height / 2 - (y - app.view.y) * app.view.scale];
}
function toWorld(left, top) {
  const [width, height] = size();
  return [app.view.x + (left - width / 2) / app.view.scale, app.view.y - (top - height / 2) / app.view.scale];
}

/** Show every way and goal. */
function fit() {
  const xs = [];
  const ys = [];
  for (const car of app.world.cars) {
    car.goals.forEach(([, x, y]) => xs.push(x) && ys.push(y));
    for (const [first, end] of car.spans)
      for (let step = first; step <= end; step += 5) {
        xs.push(read(app.world, "x", car.slot, step));
        ys.push(read(app.world, "y", car.slot, step));
      }
  }
  if (!xs.length) xs.push(0) && ys.push(0);
  const [west, east, south, north] = [Math.min(...xs), Math.max(...xs), Math.min(...ys), Math.max(...ys)];
  const [width, height] = size();
  const margin = 12;
  const scale = Math.min(width / Math.max(east - west + 2 * margin, 40), height / Math.max(north - south + 2 * margin, 40));
  app.follow = false;
  app.view = { x: (west + east) / 2, y: (south + north) / 2, scale: clamp(scale, 0.3, 60) };
  showFollow();
  refresh();
}

/** Zoom about a point of the screen, by default its middle. */
function zoom(factor, left, top) {
  const [width, height] = size();
  [left, top] = app.follow || left === undefined ? [width / 2, height / 2] : [left, top];
  const [x, y] = toWorld(left, top);
  const scale = clamp(app.view.scale * factor, 0.3, 120);
  app.view = { x: x - (left - width / 2) / scale, y: y + (top - height / 2) / scale, scale };
  refresh();
}

function follow(wanted) {
  app.follow = wanted && app.selected !== null;
  if (app.follow) app.view.scale = Math.max(app.view.scale, 9);
  showFollow();
  refresh();
}
