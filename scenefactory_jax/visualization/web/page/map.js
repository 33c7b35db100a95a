// ---- map: the world from above

const WHEEL_ALONG = 0.31; // of a car's length, from its middle to an axle; of its width to a wheel: for looks only
const WHEEL_ACROSS = 0.47;
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
  drawTraffic();
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

function drawTraffic() {
  const step = now();
  pen.strokeStyle = css("outline");
  pen.lineWidth = Math.max(0.06, 0.6 / app.view.scale);
  app.world.traffic.forEach((user, row) => {
    if (!within(user.spans, step)) return;
    const { x, y, yaw } = pose(app.world, "traffic:", row, app.time);
    const [length, width] = user.size;
    pen.save();
    pen.translate(x, y);
    pen.rotate(yaw);
    pen.fillStyle = css(user.parked && user.kind === "vehicle" ? "parked" : "traffic");
    outlineOf(user.kind, length, width);
    pen.fill();
    pen.stroke();
    pen.restore();
  });
}

/** People are discs, cyclists ellipses, vehicles boxes with round front corners. */
function outlineOf(kind, length, width) {
  if (kind === "pedestrian") {
    pen.beginPath();
    pen.arc(0, 0, Math.max(0.4, length / 2, 2 / app.view.scale), 0, 7);
  } else if (kind === "cyclist") {
    pen.beginPath();
    pen.ellipse(0, 0, length / 2, Math.max(width / 2, 1.5 / app.view.scale), 0, 0, 7);
  } else {
    pen.beginPath();
    pen.roundRect(
      -length / 2,
      -width / 2,
      length,
      width,
      [0.08, 0.35 * width, 0.35 * width, 0.08].map((r) => Math.min(r, length / 2)),
    );
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
  const {
    slot,
    size: [length, width],
  } = car;
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
  quad(
    [
      [0.3, 0.34],
      [0.3, -0.34],
      [0.1, -0.41],
      [0.1, 0.41],
    ],
    length,
    width,
  );
  pen.fillStyle = "rgb(255 255 255 / .35)";
  quad(
    [
      [-0.3, 0.36],
      [-0.3, -0.36],
      [-0.4, -0.3],
      [-0.4, 0.3],
    ],
    length,
    width,
  );
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
