// ---- charts: the selected car over its time

const ACTIONS = ["#2f7ed8", "#b26bd1", "#e0483e"];
const FRONT_REAR = { FL: "#2f7ed8", FR: "#2f7ed8", RL: "#dd8a1d", RR: "#dd8a1d" };
const TERM_COLOURS = { goal: "#12996a", collision: "#d62839", crash: "#7a5cc7", road_edge: "#e67e00" };
const MORE_COLOURS = ["#2f7ed8", "#1fa5a0", "#b5892b", "#8b93a0", "#d6569b", "#8a5a44", "#6a8f2f", "#5b6ee1"];
const ROOM = { left: 34, right: 6, top: 4, bottom: 4 };
const shown = []; // the charts on the page: {plot, canvas, cursor, draw, tell}

/** What can be drawn of a world: titles, units, lines {array, label, colour, dashed, unit}, and where the axis lies. */
function chartsOf(world) {
  const wheels = world.wheels.map((wheel) => ({
    array: `mu:${wheel}`,
    label: wheel,
    colour: FRONT_REAR[wheel],
    dashed: wheel.endsWith("R"),
  }));
  const grip = [{ array: "grip", label: "mean", colour: "#2f7ed8" }];
  return [
    { title: "Speed", unit: "m/s", low: 0, least: 5, digits: 2, lines: [{ array: "speed", label: "", colour: "#2f7ed8" }] },
    {
      title: "Actions",
      unit: "",
      low: -1,
      high: 1,
      digits: 2,
      lines: ["throttle", "turn", "brake"].map((array, i) => ({ array, label: array === "turn" ? "steer" : array, colour: ACTIONS[i] })),
    },
    { title: "Reward by term", unit: "a step", reward: true },
    {
      title: "Time to collision",
      unit: "s",
      low: 0,
      high: 10,
      cut: true,
      digits: 2,
      missing: `> ${replay.ttc_most}`,
      lines: [
        { array: "ttc", label: "cars", colour: "#d6569b" },
        { array: "edge_ttc", label: "road edge", colour: "#8a5a44" },
      ],
    },
    {
      title: wheels.length ? "Friction under each wheel" : "Friction",
      unit: wheels.length ? "μ" : "μ, mean of the wheels",
      low: 0,
      least: 0.5,
      digits: 3,
      lines: wheels.length ? wheels : grip,
    },
    {
      title: "Grip in use",
      unit: "largest wheel, 1 slides",
      low: 0,
      least: 1.2,
      digits: 2,
      rule: 1,
      lines: [{ array: "grip_use", label: "", colour: "#1fa5a0" }],
    },
    {
      title: "Wheel slip",
      unit: "m/s, largest wheel",
      low: 0,
      least: 1,
      digits: 2,
      lines: [{ array: "slip", label: "", colour: "#dd8a1d" }],
    },
    {
      title: "Contact force",
      unit: "kN",
      low: 0,
      least: 10,
      digits: 1,
      scale: 1e-3,
      lines: [{ array: "contact_force", label: "", colour: "#d62839" }],
    },
    {
      title: "Way to the goal",
      unit: "m",
      low: 0,
      least: 10,
      digits: 1,
      lines: [{ array: "goal_distance", label: "", colour: "#12996a" }],
    },
  ];
}

const termColour = (name, index) => TERM_COLOURS[name] ?? MORE_COLOURS[index % MORE_COLOURS.length];

/** First and last step of a car's time. */
const lifeOf = (car) => (car.spans.length ? [car.spans[0][0], Math.max(car.spans.at(-1)[1], car.spans[0][0] + 1)] : [0, 1]);

function makeCharts() {
  const car = app.world.bySlot.get(app.selected);
  $("charts").replaceChildren();
  shown.length = 0;
  if (!car) return;
  const specs = chartsOf(app.world);
  const idle = specs.filter(allZero);
  for (const spec of specs) {
    if (idle.includes(spec)) continue;
    const figure = element("figure", { className: "chart" });
    const caption = element("figcaption");
    caption.append(titleOf(spec));
    const plot = element("div", { className: `plot${spec.reward ? " tall" : ""}` });
    const picture = element("canvas");
    const cursor = element("div", { className: "cursor" });
    plot.append(picture, cursor);
    const tell = spec.reward ? rewardKeys(caption, car) : lineKeys(caption, spec, car);
    figure.append(...(spec.reward ? [caption.firstChild, plot, caption] : [caption, plot]));
    $("charts").append(figure);
    scrubOn(plot, car);
    shown.push({ plot, picture, cursor, tell, draw: spec.reward ? () => drawReward(picture, car) : () => drawLines(picture, spec, car) });
  }
  if (idle.length) {
    const titles = idle.map(({ title }) => title.toLowerCase()).join(", ");
    $("charts").append(element("p", { className: "idle quiet", textContent: `Zero for every car all the time: ${titles}.` }));
  }
  drawCharts();
}

/** Whether nothing of a chart ever leaves zero in this world: a recording has no actions, a quiet world no contact. */
function allZero({ lines }) {
  return lines !== undefined && lines.every(({ array }) => app.world.arrays[array].step === undefined && app.world.arrays[array].low === 0);
}

function titleOf({ title, unit }) {
  const bold = element("b", { textContent: title });
  bold.append(element("small", { textContent: unit }));
  return bold;
}

function element(kind, properties = {}) {
  return Object.assign(document.createElement(kind), properties);
}

const number = (value, digits) => value.toFixed(digits).replace("-", "−");

/** Legend entries with the values of now; returns the function that brings them up to date. */
function lineKeys(caption, spec, car) {
  const outputs = spec.lines.map(({ array, label, colour, dashed }) => {
    const key = element("span", { className: "key" });
    key.style.setProperty("--own", colour);
    const output = element("output");
    output.dataset.array = array;
    if (label) key.append(element("i", { className: dashed ? "dashed" : "" }), label, " ");
    key.append(output);
    caption.append(key);
    return output;
  });
  return (step) =>
    spec.lines.forEach(({ array }, i) => {
      const value = read(app.world, array, car.slot, step) * (spec.scale ?? 1);
      outputs[i].textContent = Number.isNaN(value) ? (spec.missing ?? "–") : number(value, spec.digits);
    });
}

function rewardKeys(caption, car) {
  const grid = element("div", { className: "terms" });
  const rows = [...app.world.terms.map((name, i) => [name, termColour(name, i)]), ["sum", "var(--ink)"]].map(([name, colour]) => {
    const key = element("span", { className: "key", title: `${name}: this step, and summed so far` });
    key.style.setProperty("--own", colour);
    const [output, sum] = [element("output"), element("output", { className: "sum" })];
    output.dataset.term = name;
    sum.dataset.sum = name;
    key.append(element("i", { className: "block" }), element("span", { textContent: name.replaceAll("_", " ") }), output, sum);
    grid.append(key);
    return { name, output, sum };
  });
  caption.append(grid);
  const sums = Object.fromEntries(app.world.terms.map((name) => [name, runningSum(name, car)]));
  return (step) => {
    let [total, sofar] = [0, 0];
    for (const { name, output, sum } of rows) {
      const own = name === "sum" ? total : within(car.spans, step) ? read(app.world, `term:${name}`, car.slot, step) : 0;
      const all = name === "sum" ? sofar : sums[name][step];
      output.textContent = number(own, 3);
      sum.textContent = `Σ ${number(all, 1)}`;
      [total, sofar] = [total + own, sofar + all];
    }
  };
}

function runningSum(name, car) {
  const sums = new Float64Array(app.world.steps);
  for (let step = 0, sum = 0; step < app.world.steps; step++) {
    if (within(car.spans, step)) sum += read(app.world, `term:${name}`, car.slot, step);
    sums[step] = sum;
  }
  return sums;
}

// ---- plots

/** A clean plot with its scales; `bounds` are the values at the bottom and the top. */
function begin(picture, car, bounds, ticks) {
  const ratio = devicePixelRatio || 1;
  const { width, height } = picture.parentElement.getBoundingClientRect();
  picture.width = Math.max(1, Math.round(width * ratio));
  picture.height = Math.max(1, Math.round(height * ratio));
  const brush = picture.getContext("2d");
  brush.setTransform(ratio, 0, 0, ratio, 0, 0);
  const [first, end] = lifeOf(car);
  const inner = [width - ROOM.left - ROOM.right, height - ROOM.top - ROOM.bottom];
  const right = (step) => ROOM.left + ((step - first) / (end - first)) * inner[0];
  const up = (value) => ROOM.top + (1 - (value - bounds[0]) / (bounds[1] - bounds[0])) * inner[1];
  brush.font = "10px system-ui, sans-serif";
  brush.textAlign = "right";
  brush.textBaseline = "middle";
  brush.lineWidth = 1;
  for (const tick of ticks) {
    brush.strokeStyle = css("grid");
    brush.beginPath();
    brush.moveTo(ROOM.left, up(tick));
    brush.lineTo(width - ROOM.right, up(tick));
    brush.stroke();
    brush.fillStyle = css("quiet");
    brush.fillText(String(Number(tick.toPrecision(3))).replace("-", "−"), ROOM.left - 6, clamp(up(tick), 7, height - 7));
  }
  return { brush, right, up, width, height, inner, first, end };
}

/** About three round numbers between two bounds. */
function ticksOf(low, high) {
  const rough = (high - low) / 2.5;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((part) => part * power).find((part) => part >= rough);
  const found = [];
  for (let tick = Math.ceil(low / step) * step; tick <= high + 1e-9; tick += step) found.push(tick);
  return found;
}

function drawLines(picture, spec, car) {
  const scale = spec.scale ?? 1;
  let high = spec.high ?? spec.least;
  if (spec.high === undefined)
    for (const { array } of spec.lines)
      for (const [first, end] of car.spans)
        for (let step = first; step <= end; step++) high = Math.max(high, 1.05 * scale * (read(app.world, array, car.slot, step) || 0));
  const bounds = [spec.low, high];
  const plot = begin(picture, car, bounds, ticksOf(...bounds));
  if (spec.rule !== undefined && spec.rule < high) dashedRule(plot, spec.rule);
  plot.brush.lineJoin = "round";
  for (const line of spec.lines) drawLine(plot, line, car, scale, bounds, spec.cut);
}

function dashedRule({ brush, up, width }, value) {
  brush.setLineDash([4, 3]);
  brush.strokeStyle = css("quiet");
  brush.beginPath();
  brush.moveTo(ROOM.left, up(value));
  brush.lineTo(width - ROOM.right, up(value));
  brush.stroke();
  brush.setLineDash([]);
}

function drawLine({ brush, right, up }, { array, colour, dashed }, car, scale, [low, high], cut) {
  brush.strokeStyle = colour;
  brush.lineWidth = 1.6;
  brush.setLineDash(dashed ? [5, 3] : []);
  brush.beginPath();
  for (const [first, end] of car.spans) {
    let going = false;
    for (let step = first; step <= end; step++) {
      const value = read(app.world, array, car.slot, step) * scale;
      if (Number.isNaN(value) || (cut && value > high)) {
        going = false;
        continue;
      }
      brush[going ? "lineTo" : "moveTo"](right(step), up(clamp(value, low, high)));
      going = true;
    }
  }
  brush.stroke();
  brush.setLineDash([]);
}

/** Terms stacked from zero, what rewards upwards and what costs downwards. Single large rewards reach the border and are named. */
function drawReward(picture, car) {
  const columns = app.world.terms.map((name) => app.world.array[`term:${name}`]);
  const most = rewardBounds(columns, car);
  const plot = begin(picture, car, most, ticksOf(...most));
  const pixels = Math.max(1, Math.floor(plot.inner[0]));
  plot.brush.beginPath();
  plot.brush.rect(ROOM.left, 0, plot.inner[0] + ROOM.right, plot.height);
  plot.brush.clip();
  const perPixel = (plot.end - plot.first + 1) / pixels;
  if (perPixel <= 1) eachOwnStep(car, (step) => stack(plot, car, columns, step, step, most));
  else
    for (let i = 0; i < pixels; i++)
      stack(plot, car, columns, Math.floor(plot.first + i * perPixel), Math.floor(plot.first + (i + 1) * perPixel) - 1, most);
  nameSpikes(plot, car, columns, most);
}

/** Bottom and top of the stack without its spikes: what 97 of 100 steps stay within, known events left out. */
function rewardBounds(columns, car) {
  const [costs, gains] = [[], []];
  const steady = columns.filter((_, i) => !(app.world.terms[i] in TERM_COLOURS));
  eachOwnStep(car, (step) => {
    const values = steady.map(({ columns: count, values: all }) => all[car.slot * count + step]);
    costs.push(values.reduce((sum, value) => sum + Math.max(0, -value), 0));
    gains.push(values.reduce((sum, value) => sum + Math.max(0, value), 0));
  });
  const [low, high] = [costs, gains].map((sums) => 1.3 * (sums.sort((a, b) => a - b)[Math.floor(0.97 * sums.length)] ?? 0));
  return [-Math.max(low, 0.35 * high, 0.02), Math.max(high, 0.35 * low, 0.02)];
}

function eachOwnStep(car, visit) {
  for (const [first, end] of car.spans) for (let step = first; step <= end; step++) visit(step);
}

/** One column of the stack: the mean of steps `from` to `to`, or a spike among them. */
function stack({ brush, right, up, inner, first, end }, car, columns, from, to, most) {
  const left = right(from);
  const wide = Math.max(1, (inner[0] * (to - from + 1)) / (end - first + 1)) + 0.4;
  let [above, below] = [0, 0];
  columns.forEach(({ columns: count, values }, i) => {
    let [value, spike] = [0, 0];
    for (let step = from; step <= to; step++) {
      const one = within(car.spans, step) ? values[car.slot * count + step] : 0;
      if (one > most[1] || one < most[0]) spike = one;
      value += one / (to - from + 1);
    }
    value = clamp(spike || value, ...most);
    if (!value) return;
    const base = value > 0 ? above : below;
    const top = clamp(base + value, ...most);
    brush.fillStyle = termColour(app.world.terms[i], i);
    brush.fillRect(left, Math.min(up(base), up(top)), wide, Math.abs(up(base) - up(top)));
    if (value > 0) above = top;
    else below = top;
  });
}

function nameSpikes({ brush, right, up, width }, car, columns, most) {
  brush.font = "600 10.5px system-ui, sans-serif";
  eachOwnStep(car, (step) =>
    columns.forEach(({ columns: count, values }, i) => {
      const value = values[car.slot * count + step];
      const far = Math.max(...most.map(Math.abs));
      if (Math.abs(value) <= (app.world.terms[i] in TERM_COLOURS ? far : 4 * far)) return;
      const late = right(step) > 0.6 * width;
      brush.textAlign = late ? "right" : "left";
      const text = `${app.world.terms[i].replaceAll("_", " ")} ${value > 0 ? "+" : ""}${number(value, 0)}`;
      brush.lineWidth = 3;
      brush.strokeStyle = css("panel");
      const place = [right(step) + (late ? -5 : 5), up(most[value > 0 ? 1 : 0]) + (value > 0 ? 9 : -9)];
      brush.strokeText(text, ...place);
      brush.fillStyle = termColour(app.world.terms[i], i);
      brush.fillText(text, ...place);
    }),
  );
}

function drawCharts() {
  shown.forEach((chart) => chart.draw());
  moveCursors();
}

/** Cursors and values to the time that is now. */
function moveCursors() {
  const car = app.world.bySlot.get(app.selected);
  if (!car) return;
  const step = now();
  const [first, end] = lifeOf(car);
  const share = clamp((app.time - first) / (end - first), 0, 1);
  for (const { plot, cursor, tell } of shown) {
    cursor.style.transform = `translateX(${ROOM.left + share * (plot.clientWidth - ROOM.left - ROOM.right)}px)`;
    cursor.style.opacity = app.time < first - 0.5 || app.time > end + 0.5 ? 0.25 : 1;
    tell(step);
  }
}

/** Dragging over a chart moves the time. */
function scrubOn(plot, car) {
  const go = (event) => {
    const { left, width } = plot.getBoundingClientRect();
    const [first, end] = lifeOf(car);
    seek(Math.round(first + clamp((event.clientX - left - ROOM.left) / (width - ROOM.left - ROOM.right), 0, 1) * (end - first)));
  };
  plot.addEventListener("pointerdown", (event) => {
    pause();
    plot.setPointerCapture(event.pointerId);
    go(event);
  });
  plot.addEventListener("pointermove", (event) => plot.hasPointerCapture(event.pointerId) && go(event));
}
