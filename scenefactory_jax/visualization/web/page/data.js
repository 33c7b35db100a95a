// ---- data: what the file holds, decoded when a world is first shown

const MISSING = 65535;
const replay = JSON.parse(document.getElementById("head").textContent);
const packed = [...document.querySelectorAll("script.arrays")];

/** A world with its arrays; each is {rows, columns, values} row by row. */
async function openWorld(index) {
  const head = replay.worlds[index];
  if (!head.array) {
    const bytes = await inflate(packed[index].textContent);
    head.array = Object.fromEntries(Object.entries(head.arrays).map(([name, entry]) => [name, decode(entry, bytes)]));
    head.road = roadLines(head);
    head.bySlot = new Map(head.cars.map((car) => [car.slot, car]));
    head.end = head.steps - 1;
  }
  return head;
}

async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  if (!bytes.length) return bytes;
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** The inverse of `replay_bytes.Packer.add`. */
function decode({ shape, low, step, at }, bytes) {
  const [rows, columns] = shape;
  const count = rows * columns;
  const values = new Float32Array(count).fill(low);
  if (step === undefined) return { rows, columns, values };
  for (let row = 0; row < rows; row++) {
    let code = 0;
    for (let i = row * columns; i < (row + 1) * columns; i++) {
      const folded = bytes[at + i] | (bytes[at + count + i] << 8);
      code = (code + ((folded >> 1) ^ -(folded & 1))) & 0xffff;
      values[i] = code === MISSING ? NaN : low + code * step;
    }
  }
  return { rows, columns, values };
}

/** Layer -> lines, each a flat list x, y, x, y. */
function roadLines(head) {
  const { columns, values } = head.array.road;
  const layers = {};
  let next = 0;
  for (const [name, counts] of Object.entries(head.layers)) {
    layers[name] = counts.map((count) => {
      const line = new Float32Array(2 * count);
      for (let i = 0; i < count; i++, next++) {
        line[2 * i] = values[next];
        line[2 * i + 1] = values[columns + next];
      }
      return line;
    });
  }
  return layers;
}

// ---- questions to a world

const read = (world, name, row, step) => world.array[name].values[row * world.array[name].columns + step];
const seconds = (world, step) => world.start + step * world.dt;
const within = (spans, step) => spans.some(([first, last]) => step >= first && step <= last);

/** Where something is between two steps; it jumps where it begins anew. */
function pose(world, prefix, row, time) {
  const step = Math.min(Math.floor(time), world.end);
  const after = Math.min(step + 1, world.end);
  const [x0, y0, yaw0] = ["x", "y", "yaw"].map((name) => read(world, prefix + name, row, step));
  const [x1, y1, yaw1] = ["x", "y", "yaw"].map((name) => read(world, prefix + name, row, after));
  const share = Math.hypot(x1 - x0, y1 - y0) > 100 * world.dt ? 0 : time - step;
  const turn = Math.atan2(Math.sin(yaw1 - yaw0), Math.cos(yaw1 - yaw0));
  return { x: x0 + share * (x1 - x0), y: y0 + share * (y1 - y0), yaw: yaw0 + share * turn };
}

/** 1 while a car drives, falling to 0 after its end. */
function presence(world, car, time, fade = 0.6) {
  let share = 0;
  for (const [first, last] of car.spans) {
    if (time < first) continue;
    share = Math.max(share, 1 - Math.max(0, (time - last) * world.dt) / fade);
  }
  return Math.min(1, share);
}

const goalOf = (car, step) => car.goals.findLast(([from]) => from <= step) ?? car.goals[0];
const lightNow = (light, time) => (light.shown.findLast(([from]) => from <= time + 1e-6) ?? [0, "unknown"])[1];
const counted = (world, step) => world.events.filter((event) => event.step <= step);
