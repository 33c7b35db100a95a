// ---- marks: what is drawn in pixels on top of the map, and what is under a finger

const FLASH_S = 1.2;

function drawLabels(draw) {
  pen.textAlign = "center";
  pen.textBaseline = "middle";
  pen.lineJoin = "round";
  app.world.cars.filter((car) => presence(app.world, car, app.time) === 1).forEach(draw);
}

function carLabel(car) {
  const { x, y } = pose(app.world, "", car.slot, app.time);
  const [left, top] = toScreen(x, y);
  const chosen = car.slot === app.selected;
  label(
    String(car.slot),
    left,
    top - 0.5 * Math.hypot(...car.size) * app.view.scale - (chosen ? 12 : 9),
    chosen ? 14 : 12,
    colourOf(car.slot),
  );
}

function goalLabel(car) {
  const [, x, y] = goalOf(car, now());
  if (replay.goal_radius * app.view.scale > 7) label(String(car.slot), ...toScreen(x, y), 11, colourOf(car.slot));
}

function label(text, left, top, pixels, colour) {
  pen.font = `650 ${pixels}px system-ui, sans-serif`;
  pen.lineWidth = 3.5;
  pen.strokeStyle = css("ground");
  pen.strokeText(text, left, top);
  pen.fillStyle = dark.matches ? rgb(lighten(colour, 0.35)) : rgb(colour);
  pen.fillText(text, left, top);
}

/** Events: a ring that opens with a word, then a small sign that stays; an arrival leaves none. */
function drawMarks() {
  for (const event of app.world.events) {
    const age = ((app.time - event.step) * app.world.dt) / FLASH_S;
    if (age < 0 || (age > 1 && event.name === "goal_reached")) continue;
    const [left, top] = toScreen(event.x, event.y);
    const colour = rgb(colourOfMark(event.name));
    pen.globalAlpha = 1;
    glyph(pen, event.name, left, top, age > 1 ? 5 : 7, colour);
    if (age > 1) continue;
    pen.globalAlpha = 1 - age;
    pen.beginPath();
    pen.arc(left, top, 8 + 26 * Math.sqrt(age), 0, 7);
    pen.strokeStyle = colour;
    pen.lineWidth = 2.5;
    pen.stroke();
    pen.globalAlpha = 1;
    label(replay.marks[event.name]?.label ?? event.name, left, top + 22, 12, colourOfMark(event.name));
  }
}

/** An event's shape: ring, star, cross, diamond or square. */
function glyph(brush, name, x, y, reach, colour) {
  brush.beginPath();
  if (name === "goal_reached") {
    brush.arc(x, y, reach * 0.8, 0, 7);
    brush.strokeStyle = colour;
    brush.lineWidth = 2.2;
    brush.stroke();
    return;
  }
  const corners = { collision: 10, road_edge_contact: 4, out_of_bounds: 4, numerical_error: 4 }[name] ?? 8;
  const turn = name === "numerical_error" ? Math.PI / 4 : 0;
  if (name === "road_edge_contact") {
    const arm = 0.75 * reach;
    for (const side of [1, -1]) {
      brush.moveTo(x - arm, y - side * arm);
      brush.lineTo(x + arm, y + side * arm);
    }
    for (const [paint, width] of [
      [css("panel"), 0.9 * reach],
      [colour, 0.5 * reach],
    ]) {
      brush.strokeStyle = paint;
      brush.lineWidth = width;
      brush.lineCap = "butt";
      brush.stroke();
    }
    return;
  }
  for (let corner = 0; corner < corners; corner++) {
    const far = reach * 1.15 * (name === "collision" && corner % 2 ? 0.45 : 1);
    const angle = (corner / corners) * 2 * Math.PI - Math.PI / 2 + turn;
    brush[corner ? "lineTo" : "moveTo"](x + far * Math.cos(angle), y + far * Math.sin(angle));
  }
  brush.closePath();
  brush.fillStyle = colour;
  brush.fill();
  brush.strokeStyle = css("panel");
  brush.lineWidth = 1;
  brush.stroke();
}

function showScale() {
  const metres = [1, 2, 5, 10, 20, 50, 100, 200].find((length) => length * app.view.scale >= 56) ?? 500;
  $("scale").firstElementChild.style.width = `${metres * app.view.scale}px`;
  $("scale").lastElementChild.textContent = `${metres} m`;
}

/** The car under a point of the screen, or the nearest within some pixels; null: none. */
function carAt(left, top) {
  let best = [16, null];
  for (const car of app.world.cars) {
    if (presence(app.world, car, app.time) <= 0) continue;
    const { x, y } = pose(app.world, "", car.slot, app.time);
    const [u, v] = toScreen(x, y);
    const distance = Math.max(0, Math.hypot(u - left, v - top) - 0.5 * car.size[1] * app.view.scale);
    if (distance < best[0]) best = [distance, car.slot];
  }
  return best[1];
}
