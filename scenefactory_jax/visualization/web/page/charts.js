// ---- charts: the selected car over its time

const MARGIN = { left: 34, right: 6, top: 4, bottom: 16 }; // of a plot, for its labels
const [BLUE, VIOLET, RED, ORANGE] = ["#2f7ed8", "#b26bd1", "#e0483e", "#dd8a1d"];
const charts = []; // those on the page: {plot, cursor, draw(), showValues(step)}

const line = (array, label, colour, dashed = false) => ({ array, label, colour, dashed });

/** A chart of lines. Bounds: from `low` to `high`, or to the largest value and at least `least`. */
function lineChart(title, unit, wanted, options) {
  const lines = wanted.filter(({ array }) => has(app.world, array));
  const spec = { low: 0, digits: 2, scale: 1, missing: "–", lines, ...options };
  const { arrays } = app.world; // of one value, zero: recordings have no actions, some worlds no contacts
  const isZero = lines.every(({ array }) => arrays[array].step === undefined && arrays[array].low === 0);
  const keys = (caption, car) => lineKeys(caption, spec, car);
  return { title, unit, isMissing: !lines.length, isZero, keys, draw: (picture, car) => drawLines(picture, spec, car) };
}

function chartsOf({ wheels }) {
  const friction = wheels.length
    ? wheels.map((wheel) => line(`mu:${wheel}`, wheel, wheel.startsWith("F") ? BLUE : ORANGE, wheel.endsWith("R")))
    : [line("grip", "mean", BLUE)];
  const times = [line("ttc", "cars", "#d6569b"), line("edge_ttc", "road edge", "#8a5a44")];
  const actions = [line("throttle", "throttle", BLUE), line("turn", "steer", VIOLET), line("brake", "brake", RED)];
  return [
    lineChart("Speed", "m/s", [line("speed", "", BLUE)], { least: 5 }),
    lineChart("Actions", "", actions, { low: -1, high: 1 }),
    { title: "Reward by term", unit: "a step", tall: true, isMissing: !app.world.terms.length, keys: rewardKeys, draw: drawReward },
    lineChart("Time to collision", "s", times, { high: 10, cut: true, missing: `> ${replay.max_ttc_s}` }),
    wheels.length
      ? lineChart("Friction under each wheel", "μ", friction, { least: 0.5, digits: 3 })
      : lineChart("Friction", "μ, mean of the wheels", friction, { least: 0.5, digits: 3 }),
    lineChart("Grip in use", "largest wheel, 1 slides", [line("friction_utilization", "", "#1fa5a0")], { least: 1.2, rule: 1 }),
    lineChart("Wheel slip", "m/s, largest wheel", [line("slip", "", ORANGE)], { least: 1 }),
    lineChart("Contact force", "kN", [line("contact_force", "", "#d62839")], { least: 10, digits: 1, scale: 1e-3 }),
    lineChart("Distance to the goal", "m", [line("goal_distance", "", "#12996a")], { least: 10, digits: 1 }),
  ];
}

function makeCharts() {
  const car = app.world.bySlot.get(app.selected);
  $("charts").replaceChildren();
  charts.length = 0;
  if (!car) return;
  const all = chartsOf(app.world).filter(({ isMissing }) => !isMissing);
  for (const { title, unit, isZero, tall, keys, draw } of all) {
    if (isZero) continue;
    const heading = element("b", { textContent: title }, element("small", { textContent: unit }));
    const caption = element("figcaption");
    if (!tall) caption.append(heading);
    const [picture, cursor] = [element("canvas"), element("div", { className: "cursor" })];
    const plot = element("div", { className: `plot${tall ? " tall" : ""}` }, picture, cursor);
    $("charts").append(element("figure", { className: "chart" }, ...(tall ? [heading, plot, caption] : [caption, plot])));
    scrubOn(plot, car);
    charts.push({ plot, cursor, draw: () => draw(picture, car), showValues: keys(caption, car) });
  }
  const zero = all.filter(({ isZero }) => isZero).map(({ title }) => title.toLowerCase());
  if (zero.length) {
    $("charts").append(element("p", { className: "idle quiet", textContent: `Zero for every car all the time: ${zero.join(", ")}.` }));
  }
  drawCharts();
}

function drawCharts() {
  charts.forEach((chart) => chart.draw());
  moveCursors();
}

/** First and last step of a car's time. */
const timeOf = ({ spans }) => (spans.length ? [spans[0][0], Math.max(spans.at(-1)[1], spans[0][0] + 1)] : [0, 1]);

/** Moves cursors and values to the shown time. */
function moveCursors() {
  const car = app.world.bySlot.get(app.selected);
  if (!car) return;
  const [first, last] = timeOf(car);
  const fraction = clamp((app.time - first) / (last - first), 0, 1);
  for (const { plot, cursor, showValues } of charts) {
    cursor.style.transform = `translateX(${MARGIN.left + fraction * (plot.clientWidth - MARGIN.left - MARGIN.right)}px)`;
    cursor.style.opacity = app.time < first - 0.5 || app.time > last + 0.5 ? 0.25 : 1;
    showValues(now());
  }
}

/** Dragging over a chart moves the time. */
function scrubOn(plot, car) {
  const [first, last] = timeOf(car);
  const scrub = (event) => {
    const { left, width } = plot.getBoundingClientRect();
    const fraction = (event.clientX - left - MARGIN.left) / (width - MARGIN.left - MARGIN.right);
    goTo(Math.round(first + clamp(fraction, 0, 1) * (last - first)));
  };
  plot.addEventListener("pointerdown", (event) => {
    plot.setPointerCapture(event.pointerId);
    scrub(event);
  });
  plot.addEventListener("pointermove", (event) => plot.hasPointerCapture(event.pointerId) && scrub(event));
}

// ---- axes

/** A clean plot with axes and scales; `bounds` are the values at the bottom and the top. */
function drawAxes(picture, car, bounds) {
  const { brush, width, height } = fitCanvas(picture);
  const [first, last] = timeOf(car);
  const [right, floor] = [width - MARGIN.right, height - MARGIN.bottom];
  const atStep = (step) => MARGIN.left + ((step - first) / (last - first)) * (right - MARGIN.left);
  const atValue = (value) => floor - ((value - bounds[0]) / (bounds[1] - bounds[0])) * (floor - MARGIN.top);
  Object.assign(brush, { font: "10px system-ui, sans-serif", textAlign: "right", textBaseline: "middle", lineWidth: 1 });
  Object.assign(brush, { strokeStyle: css("grid"), fillStyle: css("quiet") });
  for (const [value, text] of ticksOf(...bounds, 4)) {
    strokeLine(brush, MARGIN.left, atValue(value), right, atValue(value));
    brush.fillText(text, MARGIN.left - 6, clamp(atValue(value), 7, floor));
  }
  const { start, dt } = app.world;
  brush.textAlign = "center";
  for (const [value, text] of ticksOf(start + first * dt, start + last * dt, 6)) {
    const left = atStep((value - start) / dt);
    strokeLine(brush, left, MARGIN.top, left, floor);
    brush.fillText(`${text} s`, clamp(left, MARGIN.left + 8, width - 12), height - 6);
  }
  return { brush, atStep, atValue, right, width, height, first, last };
}

function strokeLine(brush, left, top, right, bottom) {
  brush.beginPath();
  brush.moveTo(left, top);
  brush.lineTo(right, bottom);
  brush.stroke();
}

/** Round numbers between two bounds, at most one more than `count`, each with its text, of as many decimals as their distance has. */
function ticksOf(low, high, count) {
  const minimum = (high - low) / count;
  const power = Math.floor(Math.log10(minimum));
  const factor = [1, 2, 5, 10].find((candidate) => candidate * 10 ** power >= minimum * (1 - 1e-9));
  const [step, decimals] = [factor * 10 ** power, Math.max(0, factor === 10 ? -power - 1 : -power)];
  const ticks = [];
  for (let i = Math.ceil(low / step - 1e-9); i <= high / step + 1e-9; i++) ticks.push([i * step, number(i * step, decimals)]);
  return ticks;
}

// ---- lines

/** Adds the legend of a chart of lines; returns the function that shows the values of a step. */
function lineKeys(caption, { lines, scale, digits, missing }, car) {
  const outputs = lines.map(({ array, label, colour, dashed }) => {
    const output = element("output");
    output.dataset.array = array;
    const swatch = label ? [element("i", { className: dashed ? "dashed" : "" }), label, " "] : [];
    const key = element("span", { className: "key" }, ...swatch, output);
    key.style.setProperty("--colour", colour);
    caption.append(key);
    return output;
  });
  return (step) =>
    lines.forEach(({ array }, i) => {
      const value = read(app.world, array, car.slot, step) * scale;
      outputs[i].textContent = Number.isNaN(value) ? missing : number(value, digits);
    });
}

function eachStep(car, visit) {
  for (const [first, last] of car.spans) for (let step = first; step <= last; step++) visit(step);
}

function drawLines(picture, { lines, low, high, least, scale, rule, cut }, car) {
  const valueAt = (array, step) => read(app.world, array, car.slot, step) * scale;
  let top = high ?? least;
  if (high === undefined) for (const { array } of lines) eachStep(car, (step) => (top = Math.max(top, 1.05 * valueAt(array, step) || 0)));
  const { brush, atStep, atValue, right } = drawAxes(picture, car, [low, top]);
  if (rule !== undefined && rule < top) {
    brush.setLineDash([4, 3]);
    brush.strokeStyle = css("quiet");
    strokeLine(brush, MARGIN.left, atValue(rule), right, atValue(rule));
  }
  Object.assign(brush, { lineJoin: "round", lineWidth: 1.6 });
  for (const { array, colour, dashed } of lines) {
    brush.strokeStyle = colour;
    brush.setLineDash(dashed ? [5, 3] : []);
    brush.beginPath();
    let before = null; // the last step of the line so far
    eachStep(car, (step) => {
      const value = valueAt(array, step);
      if (Number.isNaN(value) || (cut && value > top)) return;
      brush[before === step - 1 ? "lineTo" : "moveTo"](atStep(step), atValue(clamp(value, low, top)));
      before = step;
    });
    brush.stroke();
  }
}
