// ---- map: the world from above

const WHEEL_ALONG = 0.31; // of a car's length, from its middle to an axle; of its width to a wheel: for looks only
const WHEEL_ACROSS = 0.47;
const FLASH_S = 1.2;
// layer -> [colour, width in metres, thinnest width in pixels, dashes in metres]
const LINES = {
  casing: ["casing", 4.5, 4, []],
  lane: ["asphalt", 3.9, 3, []],
  bike: ["bike", 1.8, 2, []],
  centre: ["centre", 0.1, 0.7, []],
  bump: ["bump", 0.4, 1.2, []],
  "white-broken": ["white", 0.16, 0.9, [3, 6]],
  white: ["white", 0.18, 1, []],
  "yellow-broken": ["yellow", 0.16, 0.9, [3, 6]],
  yellow: ["yellow", 0.18, 1, []],
  edge: ["kerb", 0.3, 1.3, []],
};
const LIGHT_COLOURS = { go: "#16a34a", caution: "#f0a202", stop: "#dc2433", unknown: "#9aa1a9" };
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

// ---- drawing

function drawMap() {
  const ratio = devicePixelRatio || 1;
  if (app.follow) Object.assign(app.view, placeOf(app.selected));
  const { x, y, scale } = app.view;
  pen.setTransform(1, 0, 0, 1, 0, 0);
  pen.fillStyle = css("ground");
  pen.fillRect(0, 0, canvas.width, canvas.height);
  const metres = [ratio * scale, 0, 0, -ratio * scale, canvas.width / 2 - ratio * scale * x, canvas.height / 2 + ratio * scale * y];
  const pixels = [ratio, 0, 0, ratio, 0, 0];
  pen.setTransform(...metres);
  drawRoad();
  drawPosts();
  drawOthers();
  drawGoals();
  pen.setTransform(...pixels);
  drawLabels(goalLabel);
  pen.setTransform(...metres);
  drawTrails();
  app.world.cars.forEach(drawCar);
  pen.setTransform(...pixels);
  drawLabels(carLabel);
  drawMarks();
  showScale();
}

const placeOf = (slot) => {
  const { x, y } = pose(app.world, "", slot, app.time);
  return { x, y };
};

function stroke(name) {
  const [colour, width, thinnest, dashes] = LINES[name];
  pen.strokeStyle = css(colour);
  pen.lineWidth = Math.max(width, thinnest / app.view.scale);
  pen.setLineDash(dashes);
  pen.lineCap = dashes.length ? "butt" : "round";
  pen.lineJoin = "round";
  pen.stroke(paths[name]);
}

function drawRoad() {
  pen.fillStyle = css("driveway");
  pen.fill(paths.driveway);
  ["casing", "lane", "bike"].forEach(stroke);
  drawPatches();
  if (app.view.scale > 2) drawZebras();
  if (app.view.scale > 7) stroke("centre");
  ["bump", "white-broken", "white", "yellow-broken", "yellow", "edge"].forEach(stroke);
  pen.setLineDash([]);
}

function drawPatches() {
  for (const { path, colour } of paths.patches) {
    pen.fillStyle = rgb(colour, dark.matches ? 0.42 : 0.72);
    pen.fill(path);
  }
}

function drawZebras() {
  pen.strokeStyle = css("crosswalk");
  pen.lineCap = "butt";
  for (const { outline, axis } of paths.zebras) {
    pen.save();
    pen.clip(outline);
    pen.globalAlpha = 0.75;
    pen.setLineDash([0.6, 0.6]);
    pen.lineWidth = 14;
    pen.stroke(axis);
    pen.restore();
  }
}

/** Lights as bars across their lanes, stop signs as red octagons. */
function drawPosts() {
  const time = app.time * app.world.dt + app.world.start;
  for (const light of app.world.lights) {
    const state = lightNow(light, time);
    const [along, across] = [Math.max(0.9, 2.5 / app.view.scale), Math.max(1.5, 4 / app.view.scale)];
    pen.save();
    pen.translate(...light.place);
    pen.rotate(light.yaw);
    box(along, 2 * across, 0.25 * along);
    pen.fillStyle = LIGHT_COLOURS[Object.keys(LIGHT_COLOURS).find((name) => state.endsWith(name))] ?? LIGHT_COLOURS.unknown;
    pen.fill();
    pen.restore();
  }
  const reach = Math.max(0.9, 4 / app.view.scale);
  for (const [x, y] of app.world.signs) {
    pen.beginPath();
    for (let corner = 0; corner < 8; corner++) {
      const angle = ((corner + 0.5) * Math.PI) / 4;
      pen[corner ? "lineTo" : "moveTo"](x + reach * Math.cos(angle), y + reach * Math.sin(angle));
    }
    pen.closePath();
    pen.fillStyle = LIGHT_COLOURS.stop;
    pen.fill();
    pen.strokeStyle = "#ffffff";
    pen.lineWidth = 0.18 * reach;
    pen.stroke();
  }
}

/** A rounded box about the origin, as the path to fill. */
function box(length, width, radius) {
  pen.beginPath();
  pen.roundRect(-length / 2, -width / 2, length, width, Math.min(radius, length / 2, width / 2));
}

function drawOthers() {
  const step = now();
  pen.strokeStyle = css("outline");
  pen.lineWidth = Math.max(0.06, 0.6 / app.view.scale);
  app.world.others.forEach((other, row) => {
    if (!within(other.spans, step)) return;
    const { x, y, yaw } = pose(app.world, "other:", row, app.time);
    const [length, width] = other.size;
    pen.save();
    pen.translate(x, y);
    pen.rotate(yaw);
    pen.fillStyle = css(other.parked && other.kind === "vehicle" ? "parked" : "other");
    outlineOf(other.kind, length, width);
    pen.fill();
    pen.stroke();
    pen.restore();
  });
}

/** People are discs, cyclists lenses, everybody else boxes with a nose. */
function outlineOf(kind, length, width) {
  if (kind === "pedestrian") {
    pen.beginPath();
    pen.arc(0, 0, Math.max(0.4, length / 2, 2 / app.view.scale), 0, 7);
  } else if (kind === "cyclist") {
    pen.beginPath();
    pen.ellipse(0, 0, length / 2, Math.max(width / 2, 1.5 / app.view.scale), 0, 0, 7);
  } else {
    pen.beginPath();
    pen.roundRect(-length / 2, -width / 2, length, width, [0.08, 0.35 * width, 0.35 * width, 0.08].map((r) => Math.min(r, length / 2)));
  }
}

function drawGoals() {
  const step = now();
  for (const car of app.world.cars) {
    const share = presence(app.world, car, app.time);
    if (share <= 0) continue;
    const [, x, y] = goalOf(car, step);
    const chosen = car.slot === app.selected;
    pen.globalAlpha = share * (chosen ? 1 : 0.65);
    pen.strokeStyle = rgb(colourOf(car.slot));
    pen.fillStyle = rgb(colourOf(car.slot), chosen ? 0.2 : 0.08);
    pen.lineWidth = Math.max(chosen ? 0.4 : 0.2, (chosen ? 2.2 : 1.4) / app.view.scale);
    pen.beginPath();
    pen.arc(x, y, replay.goal_radius, 0, 7);
    pen.fill();
    pen.stroke();
  }
  pen.globalAlpha = 1;
}

/** The last seconds of every way, fading; of the selected car all of it, thin. */
function drawTrails() {
  pen.lineCap = "round";
  pen.lineJoin = "round";
  const chosen = app.world.bySlot.get(app.selected);
  if (chosen) {
    pen.globalAlpha = 0.4;
    pen.lineWidth = Math.max(0.12, 1.1 / app.view.scale);
    pen.strokeStyle = rgb(colourOf(chosen.slot));
    chosen.spans.forEach(([first, end]) => way(chosen.slot, first, end));
  }
  const [bins, length] = [12, TRAIL_S / app.world.dt];
  pen.lineCap = "butt";
  pen.lineWidth = Math.max(0.5, 2.4 / app.view.scale);
  for (const car of app.world.cars) {
    pen.strokeStyle = rgb(colourOf(car.slot));
    const gone = 1 - presence(app.world, car, app.time, TRAIL_S);
    for (const [first, end] of car.spans)
      for (let bin = 0; bin < bins; bin++) {
        const from = Math.max(first, app.time - ((bin + 1) * length) / bins);
        const to = Math.min(end, app.time - (bin * length) / bins);
        if (to <= from) continue;
        pen.globalAlpha = Math.max(0, 0.7 * (1 - bin / bins) * (1 - gone));
        way(car.slot, from, to);
      }
  }
  pen.globalAlpha = 1;
}

function way(slot, from, to) {
  pen.beginPath();
  const begin = pose(app.world, "", slot, from);
  pen.moveTo(begin.x, begin.y);
  for (let step = Math.floor(from) + 1; step < to; step++) {
    pen.lineTo(read(app.world, "x", slot, step), read(app.world, "y", slot, step));
  }
  const end = pose(app.world, "", slot, to);
  pen.lineTo(end.x, end.y);
  pen.stroke();
}

function drawCar(car) {
  const share = presence(app.world, car, app.time);
  if (share <= 0) return;
  const { slot, size: [length, width] } = car;
  const { x, y, yaw } = pose(app.world, "", slot, app.time);
  pen.save();
  pen.globalAlpha = share;
  pen.translate(x, y);
  pen.rotate(yaw);
  if (slot === app.selected) halo(length, width);
  if (app.view.scale > 5) drawWheels(car);
  box(length, width, 0.18 * width);
  pen.fillStyle = rgb(colourOf(slot));
  pen.fill();
  pen.strokeStyle = dark.matches ? "rgb(0 0 0 / .6)" : "rgb(20 24 30 / .55)";
  pen.lineWidth = Math.max(0.07, 0.8 / app.view.scale);
  pen.stroke();
  drawCabin(length, width);
  if (read(app.world, "brake", slot, now()) > 0.1 && within(car.spans, now())) drawBrakeLights(length, width);
  pen.restore();
}

function halo(length, width) {
  const room = Math.max(0.7, 4 / app.view.scale);
  box(length + 2 * room, width + 2 * room, 0.5 * width);
  pen.strokeStyle = css("ink");
  pen.lineWidth = Math.max(0.14, 1.6 / app.view.scale);
  pen.stroke();
}

/** Four wheels, the front ones steered. */
function drawWheels({ slot, size: [length, width] }) {
  const steer = read(app.world, "steer", slot, now());
  pen.fillStyle = dark.matches ? "#000" : "#15181c";
  for (const ahead of [1, -1])
    for (const left of [1, -1]) {
      pen.save();
      pen.translate(ahead * WHEEL_ALONG * length, left * WHEEL_ACROSS * width);
      pen.rotate(ahead > 0 ? steer : 0);
      box(0.8, 0.34, 0.08);
      pen.fill();
      pen.restore();
    }
}

/** Windows: the broad one tells the front. */
function drawCabin(length, width) {
  pen.fillStyle = "rgb(255 255 255 / .82)";
  quad([[0.3, 0.34], [0.3, -0.34], [0.1, -0.41], [0.1, 0.41]], length, width);
  pen.fillStyle = "rgb(255 255 255 / .35)";
  quad([[-0.3, 0.36], [-0.3, -0.36], [-0.4, -0.3], [-0.4, 0.3]], length, width);
}

function quad(corners, length, width) {
  pen.beginPath();
  corners.forEach(([along, across], i) => pen[i ? "lineTo" : "moveTo"](along * length, across * width));
  pen.fill();
}

function drawBrakeLights(length, width) {
  pen.fillStyle = "#ff2d3d";
  for (const side of [0.3, -0.3]) pen.fillRect(-length / 2 - 0.05, side * width - 0.16 * width, 0.3, 0.32 * width);
}

// ---- in pixels, on top

function drawLabels(draw) {
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.lineJoin = "round";
  app.world.cars.filter((car) => presence(app.world, car, app.time) === 1).forEach(draw);
}

function carLabel(car) {
  const { x, y } = pose(app.world, "", car.slot, app.time);
  const [left, top] = toScreen(x, y);
  const chosen = car.slot === app.selected;
  label(String(car.slot), left, top - 0.5 * Math.hypot(...car.size) * app.view.scale - (chosen ? 12 : 9), chosen ? 14 : 12, colourOf(car.slot));
}

function goalLabel(car) {
  const [, x, y] = goalOf(car, now());
  if (replay.goal_radius * app.view.scale > 7) label(String(car.slot), ...toScreen(x, y), 11, colourOf(car.slot));
}

function label(text, left, top, pixels, colour) {
  pen.font = `650 ${pixels}px system-ui, sans-serif`;
  pen.lineWidth = 3.5;
  pen.strokeStyle = css("ground");
  pen.strokeText(text, left, top);
  pen.fillStyle = dark.matches ? rgb(lighten(colour, 0.35)) : rgb(colour);
  pen.fillText(text, left, top);
}

/** Events: a ring that opens with a word, then a small sign that stays; an arrival leaves none. */
function drawMarks() {
  for (const event of app.world.events) {
    const age = ((app.time - event.step) * app.world.dt) / FLASH_S;
    if (age < 0 || (age > 1 && event.name === "reached")) continue;
    const [left, top] = toScreen(event.x, event.y);
    const colour = rgb(colourOfMark(event.name));
    pen.globalAlpha = 1;
    glyph(pen, event.name, left, top, age > 1 ? 5 : 7, colour);
    if (age > 1) continue;
    pen.globalAlpha = 1 - age;
    pen.beginPath();
    pen.arc(left, top, 8 + 26 * Math.sqrt(age), 0, 7);
    pen.strokeStyle = colour;
    pen.lineWidth = 2.5;
    pen.stroke();
    pen.globalAlpha = 1;
    label(replay.marks[event.name]?.label ?? event.name, left, top + 22, 12, colourOfMark(event.name));
  }
}

/** An event's shape: ring, star, cross, diamond or square. */
function glyph(brush, name, x, y, reach, colour) {
  brush.beginPath();
  if (name === "reached") {
    brush.arc(x, y, reach * 0.8, 0, 7);
    brush.strokeStyle = colour;
    brush.lineWidth = 2.2;
    brush.stroke();
    return;
  }
  const corners = { collided: 10, touched_edge: 4, crashed: 4, fault: 4 }[name] ?? 8;
  const turn = name === "fault" ? Math.PI / 4 : 0;
  if (name === "touched_edge") {
    const arm = 0.75 * reach;
    for (const side of [1, -1]) {
      brush.moveTo(x - arm, y - side * arm);
      brush.lineTo(x + arm, y + side * arm);
    }
    for (const [paint, width] of [[css("panel"), 0.9 * reach], [colour, 0.5 * reach]]) {
      brush.strokeStyle = paint;
      brush.lineWidth = width;
      brush.lineCap = "butt";
      brush.stroke();
    }
    return;
  }
  for (let corner = 0; corner < corners; corner++) {
    const far = reach * 1.15 * (name === "collided" && corner % 2 ? 0.45 : 1);
    const angle = (corner / corners) * 2 * Math.PI - Math.PI / 2 + turn;
    brush[corner ? "lineTo" : "moveTo"](x + far * Math.cos(angle), y + far * Math.sin(angle));
  }
  brush.closePath();
  brush.fillStyle = colour;
  brush.fill();
  brush.strokeStyle = css("panel");
  brush.lineWidth = 1;
  brush.stroke();
}

function showScale() {
  const metres = [1, 2, 5, 10, 20, 50, 100, 200].find((length) => length * app.view.scale >= 56) ?? 500;
  $("scale").firstElementChild.style.width = `${metres * app.view.scale}px`;
  $("scale").lastElementChild.textContent = `${metres} m`;
}

/** The car under a point of the screen, or the nearest within some pixels; null: none. */
function carAt(left, top) {
  let best = [16, null];
  for (const car of app.world.cars) {
    if (presence(app.world, car, app.time) <= 0) continue;
    const { x, y } = pose(app.world, "", car.slot, app.time);
    const [u, v] = toScreen(x, y);
    const distance = Math.max(0, Math.hypot(u - left, v - top) - 0.5 * car.size[1] * app.view.scale);
    if (distance < best[0]) best = [distance, car.slot];
  }
  return best[1];
}
