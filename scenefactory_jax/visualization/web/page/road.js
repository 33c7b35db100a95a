// ---- road: lines and surfaces, patches, crosswalks, signs and lights

// layer -> [colour, width in metres, minimum width in pixels, dashes in metres]
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
const PAINT = ["bump", "white-broken", "white", "yellow-broken", "yellow", "edge"];
const LIGHT_COLOURS = { go: "#16a34a", caution: "#f0a202", stop: "#dc2433", unknown: "#9aa1a9" };
let paths = {}; // of this world, in metres
let bridges = null; // the same of its bridges

function preparePaths(world) {
  paths = pathsOf(world.road);
  bridges = world.bridge.lane ? pathsOf(world.bridge) : null;
  paths.zebras = world.road.crosswalk.filter((line) => line.length >= 8).map(zebra);
  paths.patches = world.patches.map(({ pieces, colour }) => ({ path: pathOf(pieces.map(counterClockwise), true), colour }));
}

function pathsOf(road) {
  const found = Object.fromEntries(Object.entries(road).map(([name, lines]) => [name, pathOf(lines)]));
  return { ...found, casing: found.lane, centre: found.lane };
}

function pathOf(lines, closed = false) {
  const path = new Path2D();
  for (const line of lines) {
    for (let i = 0; i < line.length; i += 2) path[i ? "lineTo" : "moveTo"](line[i], line[i + 1]);
    if (closed) path.closePath();
  }
  return path;
}

/** A polygon's points in one direction, so that overlapping pieces fill as one. */
function counterClockwise(points) {
  const area = points.reduce((sum, [x, y], i) => {
    const [u, v] = points[(i + 1) % points.length];
    return sum + x * v - u * y;
  }, 0);
  return (area < 0 ? [...points].reverse() : points).flat();
}

/** A crosswalk's outline, and a line through its centre along its longest side: the stripes are the dashes of this line. */
function zebra(line) {
  const points = Array.from({ length: line.length / 2 }, (_, i) => [line[2 * i], line[2 * i + 1]]);
  const sides = points.map(([x, y], i) => {
    const [u, v] = points[(i + 1) % points.length];
    return [u - x, v - y];
  });
  const longest = sides.reduce((best, side) => (Math.hypot(...side) > Math.hypot(...best) ? side : best));
  const [dx, dy] = longest.map((part) => (40 * part) / Math.hypot(...longest));
  const [x, y] = centreOf(points);
  return { outline: pathOf([line], true), axis: pathOf([[x - dx, y - dy, x + dx, y + dy]]) };
}

function stroke(name, from = paths) {
  const [colour, width, minimum, dashes] = LINES[name];
  pen.strokeStyle = css(colour);
  pen.lineWidth = metres(width, minimum);
  pen.setLineDash(dashes);
  pen.lineCap = dashes.length || from !== paths ? "butt" : "round"; // a bridge goes on as the road
  pen.stroke(from[name]);
}

function drawRoad() {
  pen.fillStyle = css("driveway");
  pen.fill(paths.driveway);
  ["casing", "lane", "bike"].forEach((name) => stroke(name));
  for (const { path, colour } of paths.patches) {
    pen.fillStyle = rgb(colour, dark.matches ? 0.42 : 0.72);
    pen.fill(path);
  }
  if (app.view.scale > 2) paths.zebras.forEach(drawZebra);
  if (app.view.scale > 7) stroke("centre");
  PAINT.forEach((name) => stroke(name));
}

function drawBridges() {
  if (bridges) ["casing", "lane", "bike", ...PAINT].forEach((name) => stroke(name, bridges));
}

function drawZebra({ outline, axis }) {
  pen.save();
  pen.clip(outline);
  Object.assign(pen, { strokeStyle: css("crosswalk"), lineCap: "butt", globalAlpha: 0.75, lineWidth: 14 });
  pen.setLineDash([0.6, 0.6]);
  pen.stroke(axis);
  pen.restore();
}

/** Lights: bars across their lanes. */
function drawLights() {
  const [along, across] = [metres(0.9, 2.5), metres(1.5, 4)];
  for (const light of app.world.lights) {
    const state = lightState(light, seconds(app.world, app.time));
    const colour = Object.keys(LIGHT_COLOURS).find((name) => state.endsWith(name)) ?? "unknown";
    pen.fillStyle = LIGHT_COLOURS[colour];
    placed(...light.place, light.yaw, () => {
      box(along, 2 * across, 0.25 * along);
      pen.fill();
    });
  }
}

/** Stop signs: red octagons. */
function drawSigns() {
  const radius = metres(0.9, 4);
  pen.fillStyle = LIGHT_COLOURS.stop;
  pen.strokeStyle = "#ffffff";
  pen.lineWidth = 0.18 * radius;
  for (const [x, y] of app.world.signs) {
    star(pen, x, y, radius, { corners: 8, turn: Math.PI / 8 });
    pen.fill();
    pen.stroke();
  }
}

// ---- legend of the map

// class of the swatch in the style sheet -> label, and what the world must have
const ON_THE_MAP = {
  sign: ["stop sign", (world) => world.signs],
  light: ["traffic light", (world) => world.lights],
  crosswalk: ["crosswalk", (world) => world.road.crosswalk],
  bump: ["speed bump", (world) => world.road.bump],
  bike: ["bike lane", (world) => world.road.bike],
  driveway: ["driveway", (world) => world.road.driveway],
  traffic: ["traffic", (world) => world.traffic],
};

function showLegend() {
  const patches = new Map(app.world.patches.map(({ label, colour }) => [label, rgb(colour)]));
  const things = Object.entries(ON_THE_MAP).filter(([, [, thingsOf]]) => thingsOf(app.world).length);
  const entry = (label, className, colour = "") => {
    const swatch = element("i", { className });
    swatch.style.background = colour;
    return element("li", {}, swatch, label);
  };
  $("legend").replaceChildren(
    ...[...patches].map(([label, colour]) => entry(label, "patch", colour)),
    ...things.map(([name, [label]]) => entry(label, name)),
  );
}
