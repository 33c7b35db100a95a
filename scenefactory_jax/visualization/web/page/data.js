// ---- data: worlds of the file, decoded when first shown

const MISSING = 65535;
const replay = JSON.parse(document.getElementById("head").textContent);
const packed = [...document.querySelectorAll("script.arrays")];

/** A world with its arrays {columns, values}, row by row. */
async function openWorld(index) {
  const world = replay.worlds[index];
  if (!world.array) {
    const bytes = await inflate(packed[index].textContent);
    world.array = Object.fromEntries(Object.entries(world.arrays).map(([name, entry]) => [name, decode(entry, bytes)]));
    world.road = roadLines(world.array.road, world.layers);
    world.bridge = roadLines(world.array.bridges, world.bridges);
    world.bySlot = new Map(world.cars.map((car) => [car.slot, car]));
    world.end = world.steps - 1;
  }
  return world;
}

async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  if (!bytes.length) return bytes;
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** The inverse of `array_packing.Packer.add`. */
function decode({ shape: [rows, columns], low, step, at }, bytes) {
  const count = rows * columns;
  const values = new Float32Array(count).fill(low);
  for (let i = 0, code = 0; step !== undefined && i < count; i++) {
    const folded = bytes[at + i] | (bytes[at + count + i] << 8);
    const change = (folded >> 1) ^ -(folded & 1);
    code = ((i % columns ? code : 0) + change) & 0xffff;
    values[i] = code === MISSING ? NaN : low + code * step;
  }
  return { columns, values };
}

/** Layer -> lines, each a flat list x, y, x, y. */
function roadLines(array, layers) {
  const { columns, values } = array ?? { columns: 0, values: [] };
  let next = 0;
  const line = (count) => {
    const points = Array.from({ length: count }, (_, i) => [values[next + i], values[columns + next + i]]);
    next += count;
    return points.flat();
  };
  return Object.fromEntries(Object.entries(layers).map(([name, counts]) => [name, counts.map(line)]));
}

// ---- values of a world

const read = (world, name, row, step) => world.array[name].values[row * world.array[name].columns + step];
/** Whether a recording has a column: evaluations have no actions, rewards and wheels. */
const has = (world, name) => name in world.array;
const seconds = (world, step) => world.start + step * world.dt;
const within = (spans, step) => spans.some(([first, last]) => step >= first && step <= last);

/** Position and yaw between two steps; a jump (a respawn) is not interpolated. */
function pose(world, prefix, row, time) {
  const step = Math.min(Math.floor(time), world.end);
  const valuesAt = (at) => ["x", "y", "yaw"].map((name) => read(world, prefix + name, row, at));
  const [before, after] = [valuesAt(step), valuesAt(Math.min(step + 1, world.end))];
  const [dx, dy, turn] = after.map((value, i) => value - before[i]);
  const fraction = Math.hypot(dx, dy) > 100 * world.dt ? 0 : time - step;
  return {
    x: before[0] + fraction * dx,
    y: before[1] + fraction * dy,
    yaw: before[2] + fraction * Math.atan2(Math.sin(turn), Math.cos(turn)),
  };
}

/** Opacity of a car: 1 while it is active, falling to 0 within `fade` seconds after its end. */
function opacity(world, car, time, fade = 0.6) {
  const ages = car.spans.filter(([first]) => time >= first).map(([, last]) => Math.max(0, (time - last) * world.dt));
  return Math.max(0, 1 - Math.min(...ages) / fade);
}

const goalOf = (car, step) => car.goals.findLast(([from]) => from <= step) ?? car.goals[0];
/** State of a light; before its first change it is unknown. */
function lightState(light, time) {
  const now = light.period === null ? time : time % light.period;
  return (light.shown.findLast(([from]) => from <= now + 1e-6) ?? [0, "unknown"])[1];
}
const pastEvents = (world, step) => world.events.filter((event) => event.step <= step);
