// ---- charts: the selected car over its time

const ACTIONS = ["#2f7ed8", "#b26bd1", "#e0483e"];
const FRONT_REAR = { FL: "#2f7ed8", FR: "#2f7ed8", RL: "#dd8a1d", RR: "#dd8a1d" };
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
      lines: [{ array: "friction_utilization", label: "", colour: "#1fa5a0" }],
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
      title: "Distance to the goal",
      unit: "m",
      low: 0,
      least: 10,
      digits: 1,
      lines: [{ array: "goal_distance", label: "", colour: "#12996a" }],
    },
  ];
}

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

const number = (value, digits) => value.toFixed(digits).replace(/^-(?=0\.?0*$)/, "").replace("-", "−"); // a rounded nothing has no sign

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
