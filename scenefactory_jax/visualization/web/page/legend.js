// ---- legend: what the map shows of this world

// class of the swatch in the style sheet -> label, and whether a world has such a thing
const ON_THE_MAP = {
  sign: ["stop sign", (world) => world.signs.length],
  light: ["traffic light", (world) => world.lights.length],
  crosswalk: ["crosswalk", (world) => world.road.crosswalk.length],
  bump: ["speed bump", (world) => world.road.bump.length],
  bike: ["bike lane", (world) => world.road.bike.length],
  driveway: ["driveway", (world) => world.road.driveway.length],
  traffic: ["traffic", (world) => world.traffic.length],
};

function showLegend() {
  const patches = new Map(app.world.patches.map(({ label, colour }) => [label, colour]));
  const things = Object.entries(ON_THE_MAP).filter(([, [, has]]) => has(app.world));
  $("legend").replaceChildren(
    ...[...patches].map(([label, colour]) => legendEntry(label, "patch", rgb(colour))),
    ...things.map(([name, [label]]) => legendEntry(label, name)),
  );
}

function legendEntry(label, name, colour = "") {
  const item = element("li");
  const picture = element("i", { className: name });
  picture.style.background = colour;
  item.append(picture, label);
  return item;
}
