const SPAN = 8, COLORS = ["#2f66a8", "#c55a1e"], NAMES = [["forward", "m/s"], ["sideways", "m/s"], ["turn", "rad/s"]];
const keys = new Set(), here = location.pathname.replace(/[^/]*$/, ""), socketBase = `ws://${location.host}${here}`;
$("view").src = `view?websocket=${encodeURIComponent(socketBase + "viser")}`;
const socket = new WebSocket(socketBase + "socket");
let options = null, points = [], stick = [0, 0], typed = [0, 0, 0], dragging = false, last = "0,0,0", lastSent = 0;
const send = message => { if (socket.readyState === 1) socket.send(JSON.stringify(message)); };
function element(tag, properties = {}, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}
let errorTimer = 0;
function showError(text) { $("error").textContent = text; clearTimeout(errorTimer); errorTimer = setTimeout(() => { $("error").textContent = ""; }, 6000); }
socket.onclose = event => { $("role").textContent = `The connection has ended${event.reason ? ": " + event.reason : ""}.`; };
socket.onmessage = event => {
  const message = JSON.parse(event.data);
  if (message.error) showError(message.error);
  if (message.policies) showOptions(message);
  if (message.report) showReport(message.report);
  if (message.done && rows[message.done[0]]) rows[message.done[0]].show(message.done[1]);
};
// Options of the selects. A policy is [name, label, group].
function fillPolicies(select, policies, chosen, first) {
  const groups = new Map();
  for (const [name, label, group] of policies) {
    if (!groups.has(group)) groups.set(group, []);
    groups.get(group).push(new Option(label, name, false, name === chosen));
  }
  const whole = [...groups].flatMap(([label, entries]) => label && groups.size > 1 ? [element("optgroup", { label }, ...entries)] : entries);
  select.replaceChildren(...first, ...whole);
}
const fill = (select, values, chosen) => select.replaceChildren(...values.map(([value, text]) => new Option(text, value, false, value === chosen)));
const labelOf = name => (options.policies.find(one => one[0] === name) || ["", name])[1];
function showOptions(message) {
  if (!options || ["policy", "world", "terrain", "ghost"].some(name => message[name] !== options[name])) points = [];
  options = message; document.body.classList.toggle("real", !!message.deployed); document.body.classList.toggle("two", !!message.ghost);
  if (message.deployed) {
    $("h0").textContent = "forward command [m/s]"; $("h2").textContent = "hottest motor [°C]";
    $("h3").textContent = "roll (blue), pitch (orange) [rad]"; $("legend").hidden = true;
  }
  fillPolicies($("policy"), message.policies, message.policy, []);
  fillPolicies($("ghost"), message.policies, message.ghost, [new Option("none", "", false, !message.ghost)]);
  fill($("world"), message.worlds.map(name => [name, name]), message.world);
  if (message.terrains) fillTerrains(message);
  fill($("speed"), message.speeds.map(s => [s, s === 1 ? "real time" : `1/${Math.round(1 / s)}`]));
  if (message.pushes && !$("duration").length) fill($("duration"), message.pushes.map(s => [s, `${s} s`]));
  const steers = usable();
  for (const one of document.querySelectorAll("#side select, #side button, #side input")) one.disabled = !message.driver;
  for (const name of ["stop", "damp"]) $(name).disabled = false;
  for (const one of document.querySelectorAll("#numbers input")) one.disabled = !steers;
  (message.limits || []).forEach(([low, high], k) => {
    const input = $(`c${k}`);
    input.min = low; input.max = high; input.title = `${low} to ${high} ${NAMES[k][1]}`; if (low === high) input.disabled = true;
  });
  $("role").textContent = message.driver ? "" : "You are watching: another browser is in control.";
  $("stick").classList.toggle("off", !steers);
  $("strafe").disabled = !message.driver || !message.limits || message.limits[1][1] === 0;
  $("strafe").parentNode.hidden = !message.limits || message.limits[1][1] === 0;
  $("why").textContent = message.source && message.limits ? `Commands come from ${message.source}.` : message.limits ? "Keys: W, S forward, back; A, D sideways; Q, E turn; Esc stand. Or use a gamepad." :
    `${labelOf(message.policy)} follows no commands: it was trained for one gait and speed. Select a policy with velocity commands to steer.`;
  $("key").replaceChildren(...(message.ghost ? [["", message.policy], ["other", message.ghost]] : []).map(([kind, name]) =>
    element("div", {}, element("span", {}, element("i", { className: `dot ${kind}` }), labelOf(name)))));
  showParameters(message.live_parameters, message.driver); showForce(); showRecording(shownRecording);
}
// Terrain: each kind has [unit, meaning, minimum, maximum, step, initial value] of its size; flat ground and maps have no size.
function fillTerrains({ terrains, terrain }) {
  const [kind, number] = terrain in terrains ? [terrain] : terrain.split(":"), size = terrains[kind];
  fill($("terrain"), Object.keys(terrains).map(name => [name, name.split("/").pop().replace("_", " ")]), kind);
  for (const one of document.querySelectorAll(".sized")) one.hidden = !size;
  if (!size) return;
  [$("size").min, $("size").max, $("size").step] = size.slice(2, 5); $("size").value = number; $("size").title = size[1]; showSize();
}
const showSize = () => { $("sized").textContent = `${+(+$("size").value).toPrecision(3)} ${options.terrains[$("terrain").value][0]}`; };
$("size").oninput = showSize;
$("size").onchange = () => send({ terrain: [$("terrain").value, +$("size").value] });
$("terrain").onchange = event => { send({ terrain: [event.target.value] }); event.target.blur(); };
// Sliders in groups. A row is built once, and shows the value in the simulation.
let parameterKey = "", rows = {};
const compact = value => `${+value.toPrecision(4)}`;
function showParameters(parameters, driver) {
  const key = JSON.stringify([parameters.map(parameter => [parameter.name, parameter.nominal]), driver]);
  if (key !== parameterKey) {
    const open = new Set([...$("parameter-groups").querySelectorAll("details[open]")].map(one => one.dataset.group));
    if (!parameterKey && innerWidth > 760) open.add("body");
    parameterKey = key; rows = {};
    const groups = [...new Set(parameters.map(parameter => parameter.group))].map(group => {
      const whole = element("details", { open: open.has(group) }, element("summary", { textContent: group }, element("small")));
      whole.dataset.group = group;
      whole.append(...parameters.filter(parameter => parameter.group === group).map(parameter => parameterRow(parameter, driver, whole)));
      return whole;
    });
    $("parameter-groups").replaceChildren(...groups);
  }
  for (const parameter of parameters) rows[parameter.name].show(parameter.value);
}
function parameterRow(parameter, driver, whole) {
  const reach = parameter.nominal ? 10 * Math.abs(parameter.nominal) : parameter.high - parameter.low;
  const id = `k-${parameter.name}`, unit = parameter.unit.replace("x ", "× ");
  const slide = element("input", { type: "range", step: "any", name: parameter.name, disabled: !driver, id });
  slide.min = Math.max(parameter.low, parameter.nominal - reach); slide.max = Math.min(parameter.high, parameter.nominal + reach);
  const number = element("input", { type: "number", step: "any", min: parameter.low, max: parameter.high, disabled: !driver });
  const back = element("button", { textContent: "↺", title: `nominal: ${compact(parameter.nominal)}`, disabled: !driver });
  number.setAttribute("aria-label", `${parameter.label}, number`); back.setAttribute("aria-label", `${parameter.label}: nominal value`);
  const name = element("label", { htmlFor: id, title: `${parameter.name}: ${parameter.meaning}; ${parameter.low} to ${parameter.high}` }, parameter.label, element("small", { textContent: unit ? ` [${unit}]` : "" }));
  const row = element("div", { className: "set" }, name, slide, number, back);
  const mark = value => {
    row.classList.toggle("changed", Math.abs(value - parameter.nominal) > 1e-9 + 1e-6 * Math.abs(parameter.nominal));
    const count = whole.querySelectorAll(".changed").length;
    whole.querySelector("summary small").textContent = count ? `${count} changed` : "";
  };
  const set = value => { if (Number.isFinite(value)) { send({ set: [parameter.name, value] }); mark(value); } };
  slide.oninput = () => { number.value = compact(+slide.value); set(+slide.value); };
  number.onchange = () => { slide.value = number.value; set(parseFloat(number.value)); };
  back.onclick = () => { slide.value = parameter.nominal; number.value = compact(parameter.nominal); set(parameter.nominal); };
  rows[parameter.name] = { show: value => {
    if (![slide, number].includes(document.activeElement) || !row.matches(":active")) { slide.value = value; number.value = compact(value); }
    mark(value);
  } };
  return row;
}
// The robot's state.
function showReport(now) {
  $("pause").textContent = now.paused ? "Continue" : "Pause"; $("speed").value = now.speed;
  if (now.recording) showRecording(now.recording);
  if (now.text !== undefined) $("state").textContent = now.text;
  if (now.time === undefined) return;
  const falls = now.falls || (now.ghost && now.ghost.falls) ? `, falls: ${now.falls}${now.ghost ? ` and ${now.ghost.falls}` : ""}` : "";
  if (now.text === undefined) $("state").textContent = `${now.time.toFixed(1)} s, ${now.velocity[0].toFixed(2)} m/s, ` +
    `${Math.round(100 * now.share * now.speed)} % of real time${falls}${now.paused ? ", paused" : ""}`;
  if (points.length && now.time <= points[points.length - 1].time) return;
  points.push(now); while (points[0].time < now.time - SPAN) points.shift();
  if (document.hidden) return;
  showNumbers(now);
  const speed = k => [p => p.command && p.command[k], p => p.velocity ? p.velocity[k] : null, p => p.ghost ? p.ghost.velocity[k] : null];
  const both = name => [() => null, p => p[name], p => p.ghost ? p.ghost[name] : null];
  plot("p0", speed(0)); plot("p1", both("torque")); plot("p2", both("heat"));
  if (now.attitude) plot("p3", [() => null, p => p.attitude[0], p => p.attitude[1]]);
  else { plot("p4", speed(1)); plot("p5", speed(2)); footfalls(); }
}
const shownTime = () => points[points.length - 1].time, x = time => 1 - (shownTime() - time) / SPAN;
function plot(id, [command, measured, ghost]) {
  const line = (value, color, dash) => ({ color, dash, points: points.map(p => [p.time, value(p)]) });
  drawLines(id, x, [line(ghost, COLORS[1]), line(measured, COLORS[0]), line(command, "#1f2733", [4, 3])]);
}
function footfalls() {
  drawSteps("p3", x, options.legs.map((leg, k) => ({ name: leg, color: COLORS[0], points: points.map(p => [p.time, p.contact[k]]) })));
}
// The command as numbers.
$("numbers").append(...NAMES.map(([name, unit], k) => {
  const input = element("input", { type: "number", id: `c${k}`, step: 0.05, value: "0.00" });
  input.setAttribute("aria-label", `command ${name}`);
  input.onchange = () => {
    const [low, high] = options.limits[k], value = parseFloat(input.value);
    typed = typed.map((old, n) => n === k ? (Number.isFinite(value) ? Math.max(low, Math.min(high, value)) : 0) : +$(`c${n}`).value || 0);
    input.value = typed[k].toFixed(2); steer();
  };
  input.onkeydown = event => { if (event.key === "Enter") input.blur(); };
  const cell = kind => element("td", { className: kind, id: `${kind}${k}`, textContent: "–" });
  const measured = cell("measured"); measured.classList.add("simulated");
  return element("tr", {}, element("th", {}, name, element("small", { textContent: unit })), element("td", {}, input), measured, cell("other"));
}));
const shown = value => value === undefined || value === null ? "–" : (Math.abs(value) < 0.005 ? 0 : value).toFixed(2);
function showNumbers(now) {
  NAMES.forEach((_, k) => {
    if (document.activeElement !== $(`c${k}`)) $(`c${k}`).value = now.command ? shown(now.command[k]) : "";
    $(`measured${k}`).textContent = shown((now.velocity || [])[k]); $(`other${k}`).textContent = shown(now.ghost && now.ghost.velocity[k]);
  });
}
// The joystick, keys and gamepad.
function drag(event) {
  const box = $("stick").getBoundingClientRect(), half = box.width / 2;
  let x = (event.clientX - box.left - half) / half, y = -(event.clientY - box.top - half) / half;
  const size = Math.hypot(x, y); if (size > 1) { x /= size; y /= size; }
  stick = [y, x]; steer();
}
const usable = () => options && options.driver && options.limits && !options.source;
$("stick").onpointerdown = event => { if (usable()) { dragging = true; $("stick").setPointerCapture(event.pointerId); drag(event); } };
$("stick").onpointermove = event => { if (dragging) drag(event); };
$("stick").onpointerup = $("stick").onpointercancel = () => { dragging = false; stick = [0, 0]; steer(); };
const KEYS = { KeyW: 1, KeyS: 1, KeyA: 1, KeyD: 1, KeyQ: 1, KeyE: 1, ArrowUp: 1, ArrowDown: 1, ArrowLeft: 1, ArrowRight: 1 };
addEventListener("keydown", event => {
  if (event.code === "Escape") stand();
  const { tagName, type } = event.target, isUsed = tagName === "SELECT" || type === "number" || type === "range" && event.code.startsWith("Arrow");
  if (!KEYS[event.code] || isUsed || event.ctrlKey || event.metaKey) return;
  keys.add(event.code); event.preventDefault(); steer();
});
// Numbers are reset first, because a field that loses the focus applies what was typed into it.
function stand() {
  NAMES.forEach((_, k) => { $(`c${k}`).value = "0.00"; });
  document.activeElement.blur();
  typed = [0, 0, 0]; stick = [0, 0]; dragging = false; keys.clear(); steer();
}
addEventListener("keyup", event => { if (keys.delete(event.code)) steer(); });
addEventListener("blur", () => { keys.clear(); steer(); });
function inputs() {
  const key = (plus, minus) => plus.some(k => keys.has(k)) - minus.some(k => keys.has(k));
  let forward = stick[0] + key(["KeyW", "ArrowUp"], ["KeyS", "ArrowDown"]), sideways = key(["KeyA"], ["KeyD"]);
  let turn = key(["KeyQ", "ArrowLeft"], ["KeyE", "ArrowRight"]);
  if ($("strafe").checked) sideways -= stick[1]; else turn -= stick[1];
  const pad = [...(navigator.getGamepads ? navigator.getGamepads() : [])].find(one => one && one.connected), dead = v => Math.abs(v) < 0.12 ? 0 : v;
  if (pad) { forward -= dead(pad.axes[1] || 0); sideways -= dead(pad.axes[0] || 0); turn -= dead(pad.axes[2] || 0); }
  return [forward, sideways, turn].map(v => Math.max(-1, Math.min(1, v)));
}
// Joystick, keys and gamepad override typed numbers.
function steer() {
  if (!usable()) return;
  const input = inputs(); if (dragging || input.some(v => v !== 0)) typed = [0, 0, 0];
  const command = input.map((v, k) => typed[k] || (v > 0 ? v * options.limits[k][1] : -v * options.limits[k][0]));
  const fraction = (k, [low, high] = options.limits[k]) => command[k] > 0 ? command[k] / (high || 1) : -command[k] / (low || -1);
  const side = $("strafe").checked ? fraction(1) : fraction(2), reach = ($("stick").clientWidth - $("knob").clientWidth) / 2;
  $("knob").style.transform = `translate(${-side * reach}px, ${-fraction(0) * reach}px)`;
  const text = command.join(), now = performance.now(), moves = command.some(v => v !== 0);
  if (text === last && !(moves && now - lastSent > 300)) return;
  if (moves && text !== last && now - lastSent < 8) return;  // the timer will send it
  last = text; lastSent = now; send({ command, moved: performance.timeOrigin + now });
}
setInterval(steer, 16);
// Pushes.
const force = () => $("share").value * options.weight;
function showForce() { if (options && options.weight) $("force").textContent = `${(+$("share").value).toFixed(2)} × weight = ${force().toFixed(0)} N`; }
$("share").oninput = showForce;
$("directions").append(...[["front", 0], ["left", 90], ["right", 270], ["back", 180]].map(([name, degrees]) => element("button", {
  textContent: name, id: `push-${name}`, title: `push towards the robot's ${name}`, onclick: () => send({ push: [force(), degrees, +$("duration").value] }),
})));
// Recordings.
let shownRecording = {}, recordingKey = "", wanted = "";
const FILES = [["npz", "trace (.npz)"], ["ghost", "ghost's trace"], ["html", "page (.html)"], ["mp4", "video (.mp4)"]];
function showRecording(now) {
  shownRecording = now; $("record").classList.toggle("on", !!now.on); $("record").textContent = now.on ? `Stop ${now.duration.toFixed(1)} s` : "Record";
  const key = JSON.stringify([now.on ? "on" : now, options && options.driver]); if (key === recordingKey) return;
  recordingKey = key;
  if (now.on) { $("files").replaceChildren(element("small", { className: "quiet", textContent: `Records up to ${now.limit} s, or until the robot falls or restarts.` })); return; }
  if (!now.files) { $("files").replaceChildren(); return; }
  const entries = FILES.filter(([kind]) => kind !== "ghost" || now.files.ghost).map(([kind, text]) => {
    if (now.files[kind]) return element("a", { href: `files/${now.files[kind]}`, download: now.files[kind], textContent: text, id: `file-${kind}` });
    return element("button", { textContent: now.making === kind ? `exporting ${text} …` : `export ${text}`, id: `make-${kind}`, disabled: !!now.making || !options.driver,
      onclick: () => { wanted = kind; send({ export: kind }); } });
  });
  $("files").replaceChildren(element("div", {}, `Recorded ${now.duration.toFixed(1)} s${now.note ? `; ended because ${now.note}` : ""}.`),
    element("div", { className: "row" }, ...entries), element("small", { className: "quiet", textContent: `in ${now.folder}` }));
  if (wanted && now.files[wanted]) { $(`file-${wanted}`).click(); wanted = ""; }
}
$("record").onclick = () => send({ record: !shownRecording.on });
$("pause").onclick = () => send({ pause: $("pause").textContent === "Pause" });
for (const name of ["stop", "damp"]) $(name).onclick = () => {
  send({ [name]: true });
  if (socket.readyState !== 1) showError("Not sent: the connection has ended. Press Ctrl-C in the terminal of surefoot deploy.");
};
$("restart").onclick = () => send({ restart: true });
$("speed").onchange = event => { send({ speed: +event.target.value }); event.target.blur(); };
$("duration").onchange = event => event.target.blur();
for (const name of ["policy", "world", "ghost"]) $(name).onchange = event => { send({ [name]: event.target.value }); event.target.blur(); };
// Cameras: azimuth relative to the robot's heading, and polar angle from the vertical [rad]. Each tab has its own camera.
const CAMERAS = { free: null, behind: [0, 1.2], side: [Math.PI / 2, 1.35], front: [Math.PI, 1.25], top: [0, 0.01] };
let camera = "free", cameraTime = 0;
$("camera").append(...Object.keys(CAMERAS).map(name => element("button", { textContent: name, id: `camera-${name}`, onclick: () => setCamera(name) })));
function setCamera(name) { camera = name; for (const one of $("camera").children) one.setAttribute("aria-pressed", one.textContent === name); }
setCamera("free");
const turn = angle => Math.atan2(Math.sin(angle), Math.cos(angle));
requestAnimationFrame(function follow(time) {
  requestAnimationFrame(follow);
  const viewer = $("view").contentWindow && $("view").contentWindow.__viserMutable, control = viewer && viewer.cameraControl;
  const blend = 1 - Math.exp(-Math.min(time - cameraTime, 200) / 200); cameraTime = time;
  if (!control || !options) return;
  if (!control.surefoot) { control.surefoot = true; control.addEventListener("controlstart", () => setCamera("free")); }
  const pose = viewer.nodePoseData[options.node];
  if (!CAMERAS[camera] || !pose || !pose.wxyz) return;
  const [w, x, y, z] = pose.wxyz, yaw = Math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z));
  const about = turn(CAMERAS[camera][0] + yaw - control.azimuthAngle), down = CAMERAS[camera][1] - control.polarAngle;
  if (Math.abs(about) + Math.abs(down) < 1e-4) return;
  control.rotateTo(control.azimuthAngle + blend * about, control.polarAngle + blend * down, false); viewer.requestRender();
});
