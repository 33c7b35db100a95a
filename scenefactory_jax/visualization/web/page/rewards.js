// ---- rewards: the selected car's reward by term; looks are those of `term_styles.py`

const TILE = 12; // pixels of a pattern's tile, drawn at half its size

const termValue = (name, car, step) => (within(car.spans, step) ? read(app.world, `term:${name}`, car.slot, step) : 0);
const spaced = (name) => name.replaceAll("_", " ");

/** Fill of a term's area: its colour, with stripes, dots or crosses in the colour of the panel. */
function termFill(brush, name) {
  const { colour, pattern } = replay.terms[name];
  if (pattern === "plain") return rgb(inScheme(colour));
  const key = `fill:${name}`;
  if (!colours.has(key)) {
    const fill = brush.createPattern(patternTile(rgb(inScheme(colour)), pattern), "repeat");
    fill.setTransform(new DOMMatrix().scale(0.5));
    colours.set(key, fill);
  }
  return colours.get(key);
}

function patternTile(colour, pattern) {
  const picture = element("canvas", { width: TILE, height: TILE });
  const brush = picture.getContext("2d");
  brush.fillStyle = colour;
  brush.fillRect(0, 0, TILE, TILE);
  brush.strokeStyle = brush.fillStyle = css("panel");
  brush.lineWidth = 3;
  if (pattern === "dotted") {
    for (const place of [0.25, 0.75]) {
      disc(brush, place * TILE, place * TILE, 2.2);
      brush.fill();
    }
    return picture;
  }
  brush.beginPath();
  for (const shift of [-TILE, 0, TILE])
    for (const down of pattern === "crossed" ? [false, true] : [false]) {
      brush.moveTo(shift - 2, down ? -2 : TILE + 2);
      brush.lineTo(shift + TILE + 2, down ? TILE + 2 : -2);
    }
  brush.stroke();
  return picture;
}

/** A term's look in the legend; the sum is a line. */
function swatch(name) {
  const picture = element("canvas", { className: "swatch", width: 24, height: 24 });
  const brush = picture.getContext("2d");
  brush.scale(2, 2);
  brush.fillStyle = name === "sum" ? css("ink") : termFill(brush, name);
  brush.fillRect(0, name === "sum" ? 5 : 0, 12, name === "sum" ? 2 : 12);
  return picture;
}

/** Adds the legend of the reward; returns the function that shows the values of a step. */
function rewardKeys(caption, car) {
  const { terms, steps } = app.world;
  const values = Object.fromEntries(terms.map((name) => [name, Array.from({ length: steps }, (_, step) => termValue(name, car, step))]));
  values.sum = Array.from({ length: steps }, (_, step) => terms.reduce((sum, name) => sum + values[name][step], 0));
  const grid = element("div", { className: "terms" });
  caption.append(grid);
  const rows = Object.entries(values).map(([name, column]) => {
    let total = 0;
    const totals = column.map((value) => (total += value));
    const [output, sum] = [element("output"), element("output", { className: "sum" })];
    output.dataset.term = name;
    sum.dataset.sum = name;
    const title = `${name}: this step, and summed so far`;
    grid.append(element("span", { className: "key", title }, swatch(name), element("span", { textContent: spaced(name) }), output, sum));
    return (step) => {
      output.textContent = number(column[step], 3);
      sum.textContent = `Σ ${number(totals[step], 1)}`;
    };
  });
  return (step) => rows.forEach((show) => show(step));
}

/** Terms stacked from zero, rewards upwards and penalties downwards. Single large values reach the border and are named. */
function drawReward(picture, car) {
  const bounds = rewardBounds(car);
  const plot = drawAxes(picture, car, bounds);
  const { first, last, right, brush } = plot;
  brush.beginPath();
  brush.rect(MARGIN.left, 0, right - MARGIN.left + MARGIN.right, plot.height);
  brush.clip();
  const steps = last - first + 1;
  const columns = Math.min(steps, Math.max(1, Math.floor(right - MARGIN.left)));
  const begin = (column) => first + Math.floor((column * steps) / columns);
  for (let i = 0; i < columns; i++) drawStack(plot, car, begin(i), begin(i + 1) - 1, bounds);
  nameSpikes(plot, car, bounds);
}

/** Bottom and top without spikes: the bounds of 97 of 100 steps, terms of events left out. */
function rewardBounds(car) {
  const steady = app.world.terms.filter((name) => !replay.terms[name].spike);
  const [penalties, gains] = [[], []];
  eachStep(car, (step) => {
    const values = steady.map((name) => termValue(name, car, step));
    penalties.push(values.reduce((sum, value) => sum + Math.max(0, -value), 0));
    gains.push(values.reduce((sum, value) => sum + Math.max(0, value), 0));
  });
  const [low, high] = [penalties, gains].map((sums) => 1.3 * (sums.sort((a, b) => a - b)[Math.floor(0.97 * sums.length)] ?? 0));
  return [-Math.max(low, 0.35 * high, 0.02), Math.max(high, 0.35 * low, 0.02)];
}

/** One column of the stack: the mean of the steps `from` to `to`, or a spike among them. */
function drawStack({ brush, atStep, atValue, right, first, last }, car, from, to, bounds) {
  const left = Math.floor(atStep(from));
  const stepWidth = (right - MARGIN.left) / (last - first + 1);
  const width = Math.ceil(atStep(from) + Math.max(1, stepWidth * (to - from + 1))) - left; // whole pixels: no seams
  let [above, below] = [0, 0];
  for (const name of app.world.terms) {
    const values = Array.from({ length: to - from + 1 }, (_, i) => termValue(name, car, from + i));
    const spike = values.findLast((value) => value > bounds[1] || value < bounds[0]);
    const value = spike ?? values.reduce((sum, one) => sum + one, 0) / values.length;
    if (!value) continue;
    const base = value > 0 ? above : below;
    const top = clamp(base + value, ...bounds);
    brush.fillStyle = termFill(brush, name);
    brush.fillRect(left, Math.min(atValue(base), atValue(top)), width, Math.abs(atValue(base) - atValue(top)));
    if (value > 0) above = top;
    else below = top;
  }
}

function nameSpikes({ brush, atStep, atValue, width }, car, bounds) {
  const far = Math.max(...bounds.map(Math.abs));
  eachStep(car, (step) => {
    for (const name of app.world.terms) {
      const value = termValue(name, car, step);
      if (Math.abs(value) <= (replay.terms[name].spike ? far : 4 * far)) continue;
      const late = atStep(step) > 0.6 * width;
      brush.textAlign = late ? "right" : "left";
      const text = `${spaced(name)} ${value > 0 ? "+" : ""}${number(value, 0)}`;
      const colour = rgb(inScheme(replay.terms[name].colour));
      const [left, top] = [atStep(step) + (late ? -5 : 5), atValue(bounds[value > 0 ? 1 : 0]) + (value > 0 ? 9 : -9)];
      rimmedText(brush, text, left, top, { font: "600 10.5px system-ui, sans-serif", rim: css("panel"), rimWidth: 3, colour });
    }
  });
}
