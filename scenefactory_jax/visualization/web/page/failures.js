// ---- failures: where the metrics of a scored episode fail, a row for each metric over the selected car's time

/** Metrics of a car and their failures, in the order of the file. */
const metricsOf = (car) => (app.world.metrics[car?.slot] ? Object.keys(replay.metrics).map((name) => [name, app.world.metrics[car.slot][name]]) : []);
/** The last step that counts in scores. */
const lastCounted = (car) => app.world.metrics[car.slot].counted.at(-1)?.[1] ?? 0;

/** All failures of a car in order: {name, first, last}. */
function failuresOf(car) {
  const metrics = metricsOf(car);
  const all = metrics.flatMap(([name, spans]) => (spans ?? []).map(([first, last]) => ({ name, first, last: Math.min(last, app.world.end) })));
  return all.filter(({ first }) => first <= app.world.end).sort((a, b) => a.first - b.first);
}

function makeFailures() {
  const car = app.world.bySlot.get(app.selected);
  const metrics = metricsOf(car);
  $("failures").hidden = !metrics.length;
  if (!metrics.length) return;
  const names = (chosen) => chosen.map(([name]) => replay.metrics[name]).join(", ");
  const notes = { "No failure": metrics.filter(([, spans]) => spans && !spans.length), "Absent": metrics.filter(([, spans]) => !spans) };
  const rows = metrics.filter(([, spans]) => spans?.length).map(([name]) => failureRow(car, name));
  const lines = Object.entries(notes).filter(([, chosen]) => chosen.length);
  const texts = lines.map(([title, chosen]) => element("p", { className: "quiet", textContent: `${title}: ${names(chosen)}.` }));
  const count = lastCounted(car) < timeOf(car)[1] ? `scores count up to ${number(seconds(app.world, lastCounted(car)), 2)} s` : "";
  const heading = element("b", { textContent: "Where metrics fail" }, element("small", { className: "quiet", textContent: count }));
  $("failures").replaceChildren(heading, ...rows, ...texts);
}

function failureRow(car, name) {
  const [begin, end] = timeOf(car);
  const place = (step) => (100 * (clamp(step, begin, end) - begin)) / (end - begin);
  const found = failuresOf(car).filter((failure) => failure.name === name);
  const marks = found.map((failure) => {
    const [from, to] = [failure.first, failure.last].map((step) => number(seconds(app.world, step), 2));
    const text = `${replay.metrics[name]}, ${from === to ? from : `${from} to ${to}`} s`;
    const mark = element("button", { type: "button", title: text });
    mark.setAttribute("aria-label", text);
    mark.dataset.metric = name;
    mark.dataset.first = String(failure.first);
    mark.dataset.last = String(failure.last);
    mark.style.left = `min(${place(failure.first)}%, 100% - 7px)`;
    mark.style.width = `${place(failure.last) - place(failure.first)}%`;
    mark.addEventListener("click", () => goTo(failure.first));
    return mark;
  });
  const label = element("span", { textContent: replay.metrics[name], title: replay.metrics[name] });
  const at = element("span", { className: "at", textContent: `${number(seconds(app.world, found[0].first), 2)} s` });
  const over = element("div", { className: "over" });
  over.style.left = `${place(lastCounted(car))}%`;
  return element("div", { className: "failure" }, label, element("div", { className: "track" }, over, ...marks, element("i")), at);
}

/** Moves the rows' cursors to the shown time, and marks the failures of now. */
function showFailures() {
  const car = app.world.bySlot.get(app.selected);
  const [begin, end] = timeOf(car);
  const left = `${(100 * clamp(app.time - begin, 0, end - begin)) / (end - begin)}%`;
  for (const cursor of document.querySelectorAll("#failures .track i")) cursor.style.left = left;
  for (const mark of document.querySelectorAll("#failures .track button"))
    mark.classList.toggle("now", Number(mark.dataset.first) <= now() && now() <= Number(mark.dataset.last));
}

function toFailure(by) {
  const car = app.world.bySlot.get(app.selected);
  const all = car ? failuresOf(car) : [];
  const target = by > 0 ? all.find(({ first }) => first > now()) : all.findLast(({ first }) => first < now());
  if (target) goTo(target.first);
}
