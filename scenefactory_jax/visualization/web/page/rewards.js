// ---- rewards: the selected car's reward by term; a term's look is the table's in `term_looks.py`

const TILE = 12; // pixels of a pattern's tile, drawn at half its size

/** What an area of a term is filled with: its colour, and stripes, dots or crosses in the colour of the panel. */
function termFill(brush, name) {
  const { colour, pattern } = replay.terms[name];
  if (pattern === "plain") return rgb(inScheme(colour));
  const key = `fill:${name}`;
  if (!colours.has(key)) {
    const fill = brush.createPattern(tile(rgb(inScheme(colour)), pattern), "repeat");
    fill.setTransform(new DOMMatrix().scale(0.5));
    colours.set(key, fill);
  }
  return colours.get(key);
}

function tile(colour, pattern) {
  const picture = element("canvas", { width: TILE, height: TILE });
  const brush = picture.getContext("2d");
  brush.fillStyle = colour;
  brush.fillRect(0, 0, TILE, TILE);
  brush.strokeStyle = brush.fillStyle = css("panel");
  brush.lineWidth = 3;
  brush.beginPath();
  for (const shift of [-TILE, 0, TILE]) {
    if (pattern === "dotted") continue;
    brush.moveTo(shift - 2, TILE + 2);
    brush.lineTo(shift + TILE + 2, -2);
    if (pattern === "striped") continue;
    brush.moveTo(shift - 2, -2);
    brush.lineTo(shift + TILE + 2, TILE + 2);
  }
  brush.stroke();
  for (const place of pattern === "dotted" ? [0.25, 0.75] : []) {
    brush.beginPath();
    brush.arc(place * TILE, place * TILE, 2.2, 0, 7);
    brush.fill();
  }
  return picture;
}

/** A term's look in the legend; the sum is a line. */
function swatch(name) {
  const [picture, side] = [element("canvas", { className: "swatch", width: 24, height: 24 }), 12];
  const brush = picture.getContext("2d");
  brush.scale(2, 2);
  brush.fillStyle = name === "sum" ? css("ink") : termFill(brush, name);
  brush.fillRect(0, name === "sum" ? 5 : 0, side, name === "sum" ? 2 : side);
  return picture;
}

function rewardKeys(caption, car) {
  const grid = element("div", { className: "terms" });
  const rows = [...app.world.terms, "sum"].map((name) => {
    const key = element("span", { className: "key", title: `${name}: this step, and summed so far` });
    const [output, sum] = [element("output"), element("output", { className: "sum" })];
    output.dataset.term = name;
    sum.dataset.sum = name;
    key.append(swatch(name), element("span", { textContent: name.replaceAll("_", " ") }), output, sum);
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

/** Terms stacked from zero, what rewards upwards and what costs downwards. Single large rewards reach the border and are named. */
function drawReward(picture, car) {
  const columns = app.world.terms.map((name) => app.world.array[`term:${name}`]);
  const most = rewardBounds(columns, car);
  const plot = begin(picture, car, most);
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
  const steady = columns.filter((_, i) => !replay.terms[app.world.terms[i]].spike);
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
  const left = Math.floor(right(from));
  const wide = Math.ceil(right(from) + Math.max(1, (inner[0] * (to - from + 1)) / (end - first + 1))) - left; // whole pixels: no seams
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
    brush.fillStyle = termFill(brush, app.world.terms[i]);
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
      if (Math.abs(value) <= (replay.terms[app.world.terms[i]].spike ? far : 4 * far)) return;
      const late = right(step) > 0.6 * width;
      brush.textAlign = late ? "right" : "left";
      const text = `${app.world.terms[i].replaceAll("_", " ")} ${value > 0 ? "+" : ""}${number(value, 0)}`;
      brush.lineWidth = 3;
      brush.strokeStyle = css("panel");
      const place = [right(step) + (late ? -5 : 5), up(most[value > 0 ? 1 : 0]) + (value > 0 ? 9 : -9)];
      brush.strokeText(text, ...place);
      brush.fillStyle = rgb(inScheme(replay.terms[app.world.terms[i]].colour));
      brush.fillText(text, ...place);
    }),
  );
}
