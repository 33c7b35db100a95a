// ---- plots: axes with ticks, and lines in them

const ROOM = { left: 34, right: 6, top: 4, bottom: 16 };

/** A clean plot with its scales; `bounds` are the values at the bottom and the top. */
function begin(picture, car, bounds) {
  const { brush, width, height } = fitCanvas(picture);
  const [first, end] = lifeOf(car);
  const inner = [width - ROOM.left - ROOM.right, height - ROOM.top - ROOM.bottom];
  const right = (step) => ROOM.left + ((step - first) / (end - first)) * inner[0];
  const up = (value) => ROOM.top + (1 - (value - bounds[0]) / (bounds[1] - bounds[0])) * inner[1];
  brush.font = "10px system-ui, sans-serif";
  brush.textAlign = "right";
  brush.textBaseline = "middle";
  brush.lineWidth = 1;
  const floor = height - ROOM.bottom;
  brush.strokeStyle = css("grid");
  brush.fillStyle = css("quiet");
  for (const { value, text } of ticksOf(...bounds, 4)) {
    rule(brush, ROOM.left, up(value), width - ROOM.right, up(value));
    brush.fillText(text, ROOM.left - 6, clamp(up(value), 7, floor));
  }
  const { start, dt } = app.world;
  brush.textAlign = "center";
  for (const { value, text } of ticksOf(start + first * dt, start + end * dt, 6)) {
    const left = right((value - start) / dt);
    rule(brush, left, ROOM.top, left, floor);
    brush.fillText(`${text} s`, clamp(left, ROOM.left + 8, width - 12), height - 6);
  }
  return { brush, right, up, width, height, inner, first, end };
}

function rule(brush, left, top, right, bottom) {
  brush.beginPath();
  brush.moveTo(left, top);
  brush.lineTo(right, bottom);
  brush.stroke();
}

/** Round numbers between two bounds, at most one more than `most`, each with its text: digits, as many behind the point as the step has. */
function ticksOf(low, high, most) {
  const rough = (high - low) / most;
  const power = Math.floor(Math.log10(rough));
  const steps = [1, 2, 5, 10].map((part) => [part * 10 ** power, Math.max(0, part === 10 ? -power - 1 : -power)]);
  const [step, decimals] = steps.find(([one]) => one >= rough * (1 - 1e-9));
  const found = [];
  for (let i = Math.ceil(low / step - 1e-9); i <= high / step + 1e-9; i++) found.push({ value: i * step, text: number(i * step, decimals) });
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
  const plot = begin(picture, car, bounds);
  if (spec.rule !== undefined && spec.rule < high) dashedRule(plot, spec.rule);
  plot.brush.lineJoin = "round";
  for (const line of spec.lines) drawLine(plot, line, car, scale, bounds, spec.cut);
}

function dashedRule({ brush, up, width }, value) {
  brush.setLineDash([4, 3]);
  brush.strokeStyle = css("quiet");
  rule(brush, ROOM.left, up(value), width - ROOM.right, up(value));
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
