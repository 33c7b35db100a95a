// ---- address: time, car and world in the page's address, `#t=12.3&car=4&world=2`

const ADDRESS_MS = 500; // between two changes of it: browsers refuse more than some a second
const address = { text: location.hash, at: 0 };

/** What the address says now is shown: seconds, a car's number or `none`, a world's number; the rest stays as it is. */
async function openAddress() {
  const fields = new URLSearchParams(location.hash.slice(1));
  const asked = (name) => (fields.get(name) ? Number(fields.get(name)) : NaN);
  const index = clamp(Number.isInteger(asked("world")) ? asked("world") - 1 : app.index, 0, replay.worlds.length - 1);
  if (!app.world || index !== app.index) await chooseWorld(index);
  if (fields.get("car") === "none") select(null);
  else if (app.world.bySlot.has(asked("car"))) select(asked("car"));
  if (!Number.isFinite(asked("t"))) return;
  pause();
  seek(Math.round((asked("t") - app.world.start) / app.world.dt));
}

/** The address follows time, car and world without new entries in the browser's history. In a frame it is not visible. */
function keepAddress(stamp) {
  if (window.parent !== window || stamp - address.at < ADDRESS_MS) return;
  const time = Number(seconds(app.world, now()).toFixed(2));
  const text = `#t=${time}&car=${app.selected ?? "none"}&world=${app.index + 1}`;
  if (text === address.text) return;
  Object.assign(address, { text, at: stamp });
  history.replaceState(null, "", location.href.split("#")[0] + text);
}
