// ---- map: the world from above, in layers

const TRAIL_S = 3;
const FLASH_S = 1.2;
const pen = canvas.getContext("2d");

// from bottom to top; in metres, or in pixels of the screen
const LAYERS = [
  { inMetres: true, draws: [drawRoad, drawLights, drawSigns, drawCovered, drawBridges, () => drawTraffic(), drawGoals] },
  { inMetres: false, draws: [drawGoalLabels] },
  { inMetres: true, draws: [drawTrails, () => drawCars()] },
  { inMetres: false, draws: [drawCarLabels, drawEvents] },
];

function drawMap() {
  const ratio = devicePixelRatio || 1;
  if (app.follow) {
    const { x, y } = pose(app.world, "", app.selected, app.time);
    Object.assign(app.view, { x, y });
  }
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.fillStyle = css("ground");
  pen.fillRect(0, 0, screen.width + 1, screen.height + 1);
  pen.lineJoin = "round";
  const [left, top] = toScreen(0, 0);
  for (const { inMetres, draws } of LAYERS)
    for (const drawLayer of draws) {
      pen.save();
      if (inMetres) pen.transform(app.view.scale, 0, 0, -app.view.scale, left, top);
      drawLayer();
      pen.restore();
    }
  const length = [1, 2, 5, 10, 20, 50, 100, 200].find((metre) => metre * app.view.scale >= 56) ?? 500;
  $("scale").firstElementChild.style.width = `${length * app.view.scale}px`;
  $("scale").lastElementChild.textContent = `${length} m`;
}

// ---- shapes

/** A length in metres that is at least so many pixels on the screen. */
const metres = (length, pixels) => Math.max(length, pixels / app.view.scale);

function placed(x, y, yaw, drawShape) {
  pen.save();
  pen.translate(x, y);
  pen.rotate(yaw);
  drawShape();
  pen.restore();
}

/** The path of a rounded box about the origin; `radius` may be a list of the four corners'. */
function box(length, width, radius) {
  pen.beginPath();
  pen.roundRect(
    -length / 2,
    -width / 2,
    length,
    width,
    [radius].flat().map((r) => Math.min(r, length / 2, width / 2)),
  );
}

function disc(brush, x, y, radius) {
  brush.beginPath();
  brush.arc(x, y, radius, 0, 7);
}

/** The path of a regular polygon, or of a star whose every second corner is at the fraction `inner` of the radius. */
function star(brush, x, y, radius, { corners, inner = 1, turn = 0 }) {
  brush.beginPath();
  for (let corner = 0; corner < corners; corner++) {
    const far = radius * (corner % 2 ? inner : 1);
    const angle = (corner / corners) * 2 * Math.PI + turn;
    brush.lineTo(x + far * Math.cos(angle), y + far * Math.sin(angle));
  }
  brush.closePath();
}

/** A text with a rim in the colour of what is behind it. */
function rimmedText(brush, text, left, top, { font, rim, colour, rimWidth }) {
  Object.assign(brush, { font, strokeStyle: rim, lineWidth: rimWidth, fillStyle: colour });
  brush.strokeText(text, left, top);
  brush.fillText(text, left, top);
}

// ---- traffic

/** What is under a bridge, which is drawn over it. */
function drawCovered() {
  if (!bridges) return;
  drawTraffic(true);
  drawCars(true);
}

function drawTraffic(covered = false) {
  pen.strokeStyle = css("outline");
  pen.lineWidth = metres(0.06, 0.6);
  app.world.traffic.forEach((user, row) => {
    if (!within(user.spans, now()) || within(user.covered, now()) !== covered) return;
    const { x, y, yaw } = pose(app.world, "traffic:", row, app.time);
    pen.fillStyle = css(user.parked && user.kind === "vehicle" ? "parked" : "traffic");
    placed(x, y, yaw, () => {
      outline(user.kind, ...user.size);
      pen.fill();
      pen.stroke();
    });
  });
}

/** People are discs, cyclists ellipses, vehicles boxes with round front corners. */
function outline(kind, length, width) {
  if (kind === "pedestrian") disc(pen, 0, 0, Math.max(0.4, metres(length / 2, 2)));
  else if (kind === "cyclist") {
    pen.beginPath();
    pen.ellipse(0, 0, length / 2, metres(width / 2, 1.5), 0, 0, 7);
  } else box(length, width, [0.08, 0.35 * width, 0.35 * width, 0.08]);
}

// ---- goals and trails

function drawGoals() {
  for (const car of app.world.cars) {
    const chosen = car.slot === app.selected;
    const colour = carColour(car.slot);
    const [, x, y] = goalOf(car, now());
    pen.globalAlpha = opacity(app.world, car, app.time) * (chosen ? 1 : 0.65);
    pen.strokeStyle = rgb(colour);
    pen.fillStyle = rgb(colour, chosen ? 0.2 : 0.08);
    pen.lineWidth = chosen ? metres(0.4, 2.2) : metres(0.2, 1.4);
    disc(pen, x, y, replay.goal_radius_m);
    pen.fill();
    pen.stroke();
  }
}

/** The last seconds of every trajectory, fading; of the selected car all of it, thin. */
function drawTrails() {
  const chosen = app.world.bySlot.get(app.selected);
  if (chosen) {
    pen.lineCap = "round";
    pen.globalAlpha = 0.4;
    pen.lineWidth = metres(0.12, 1.1);
    pen.strokeStyle = rgb(carColour(chosen.slot));
    chosen.spans.forEach(([first, last]) => strokeTrajectory(chosen.slot, first, last));
  }
  const [pieces, length] = [12, TRAIL_S / app.world.dt / 12];
  pen.lineCap = "butt";
  pen.lineWidth = metres(0.5, 2.4);
  for (const car of app.world.cars) {
    pen.strokeStyle = rgb(carColour(car.slot));
    for (let piece = 0; piece < pieces; piece++) {
      pen.globalAlpha = 0.7 * (1 - piece / pieces) * opacity(app.world, car, app.time, TRAIL_S);
      for (const [first, last] of car.spans)
        strokeTrajectory(car.slot, Math.max(first, app.time - (piece + 1) * length), Math.min(last, app.time - piece * length));
    }
  }
}

function strokeTrajectory(slot, from, to) {
  if (to <= from) return;
  const steps = [from];
  for (let step = Math.floor(from) + 1; step < to; step++) steps.push(step);
  pen.beginPath();
  for (const step of [...steps, to]) {
    const { x, y } = pose(app.world, "", slot, step);
    pen.lineTo(x, y);
  }
  pen.stroke();
}

// ---- cars

function drawCars(covered = false) {
  for (const car of app.world.cars) if (within(car.covered, now()) === covered) drawCar(car);
}

function drawCar(car) {
  const visible = opacity(app.world, car, app.time);
  if (visible <= 0) return;
  const { slot, size } = car;
  const [length, width] = size;
  const { x, y, yaw } = pose(app.world, "", slot, app.time);
  placed(x, y, yaw, () => {
    pen.globalAlpha = visible;
    if (slot === app.selected) drawHalo(length, width);
    if (app.view.scale > 5) drawWheels(car);
    box(length, width, 0.18 * width);
    pen.fillStyle = rgb(carColour(slot));
    pen.fill();
    pen.strokeStyle = dark.matches ? "rgb(0 0 0 / .6)" : "rgb(20 24 30 / .55)";
    pen.lineWidth = metres(0.07, 0.8);
    pen.stroke();
    drawWindow(0.3, 0.34, 0.1, 0.41, 0.82, size); // the wide one shows the front
    drawWindow(-0.3, 0.36, -0.4, 0.3, 0.35, size);
    if (!(has(app.world, "brake") && read(app.world, "brake", slot, now()) > 0.1 && within(car.spans, now()))) return;
    pen.fillStyle = "#ff2d3d";
    for (const side of [0.3, -0.3]) pen.fillRect(-length / 2 - 0.05, (side - 0.16) * width, 0.3, 0.32 * width);
  });
}

function drawHalo(length, width) {
  const room = metres(0.7, 4);
  box(length + 2 * room, width + 2 * room, 0.5 * width);
  pen.strokeStyle = css("ink");
  pen.lineWidth = metres(0.14, 1.6);
  pen.stroke();
}

/** Four wheels, the front ones steered; their places are for looks only. */
function drawWheels({ slot, size: [length, width] }) {
  pen.fillStyle = dark.matches ? "#000" : "#15181c";
  for (const along of [0.31, -0.31])
    for (const across of [0.47, -0.47])
      placed(along * length, across * width, along > 0 && has(app.world, "steer") ? read(app.world, "steer", slot, now()) : 0, () => {
        box(0.8, 0.34, 0.08);
        pen.fill();
      });
}

/** A trapezoid; its ends as fractions of the car's length, their half widths as fractions of its width. */
function drawWindow(front, frontHalf, rear, rearHalf, alpha, [length, width]) {
  pen.fillStyle = `rgb(255 255 255 / ${alpha})`;
  pen.beginPath();
  pen.lineTo(front * length, frontHalf * width);
  pen.lineTo(front * length, -frontHalf * width);
  pen.lineTo(rear * length, -rearHalf * width);
  pen.lineTo(rear * length, rearHalf * width);
  pen.fill();
}

// ---- labels and events, in pixels

function drawCarLabels() {
  for (const car of app.world.cars) {
    const { x, y } = pose(app.world, "", car.slot, app.time);
    const [left, top] = toScreen(x, y);
    const chosen = car.slot === app.selected;
    drawLabel(car, left, top - 0.5 * Math.hypot(...car.size) * app.view.scale - (chosen ? 12 : 9), chosen ? 14 : 12);
  }
}

function drawGoalLabels() {
  if (replay.goal_radius_m * app.view.scale <= 7) return;
  for (const car of app.world.cars) drawLabel(car, ...toScreen(...goalOf(car, now()).slice(1)), 11);
}

function drawLabel(car, left, top, pixels) {
  if (opacity(app.world, car, app.time) === 1) mapText(String(car.slot), left, top, pixels, carColour(car.slot));
}

function mapText(text, left, top, pixels, colour) {
  Object.assign(pen, { textAlign: "center", textBaseline: "middle" });
  const look = { rim: css("ground"), rimWidth: 3.5, colour: rgb(dark.matches ? lighten(colour, 0.35) : colour) };
  rimmedText(pen, text, left, top, { font: `650 ${pixels}px system-ui, sans-serif`, ...look });
}

/** Events: a ring that opens, with a label, then a small glyph that stays; a reached goal leaves none. */
function drawEvents() {
  for (const event of app.world.events) {
    const age = ((app.time - event.step) * app.world.dt) / FLASH_S;
    if (age < 0 || (age > 1 && event.name === "goal_reached")) continue;
    const [left, top] = toScreen(event.x, event.y);
    const colour = eventColour(event.name);
    pen.globalAlpha = 1;
    drawGlyph(pen, event.name, left, top, age > 1 ? 5 : 7, rgb(colour));
    if (age > 1) continue;
    pen.globalAlpha = 1 - age;
    disc(pen, left, top, 8 + 26 * Math.sqrt(age));
    Object.assign(pen, { strokeStyle: rgb(colour), lineWidth: 2.5 });
    pen.stroke();
    pen.globalAlpha = 1;
    mapText(eventLabel(event.name), left, top + 22, 12, colour);
  }
}

// filled shapes of events, of the map and of the timeline; a reached goal is a ring, contact with a road edge a cross
const GLYPHS = {
  collision: { corners: 10, inner: 0.45 },
  out_of_bounds: { corners: 4 },
  numerical_error: { corners: 4, turn: Math.PI / 4 },
  red_light: { corners: 3, turn: Math.PI },
  stop_sign: { corners: 8, turn: Math.PI / 8 },
  off_route: { corners: 6 },
};

function drawGlyph(brush, name, x, y, radius, colour) {
  const outlines = [[css("panel"), 1]];
  if (name === "goal_reached") {
    disc(brush, x, y, 0.8 * radius);
    outlines[0] = [colour, 2.2];
  } else if (name === "road_edge_contact") {
    const arm = 0.75 * radius;
    brush.beginPath();
    for (const side of [1, -1]) {
      brush.moveTo(x - arm, y - side * arm);
      brush.lineTo(x + arm, y + side * arm);
    }
    outlines.splice(0, 1, [css("panel"), 0.9 * radius], [colour, 0.5 * radius]);
  } else {
    const { corners, inner, turn = 0 } = GLYPHS[name] ?? { corners: 8 };
    star(brush, x, y, 1.15 * radius, { corners, inner, turn: turn - Math.PI / 2 });
    brush.fillStyle = colour;
    brush.fill();
  }
  for (const [strokeStyle, lineWidth] of outlines) {
    Object.assign(brush, { strokeStyle, lineWidth, lineCap: "butt" });
    brush.stroke();
  }
}
