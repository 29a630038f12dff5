// The page: camera, sliders, clip; pictures come from workers that run splats.js.
"use strict";

const find = id => document.getElementById(id);
const canvas = find("picture"), context = canvas.getContext("2d");
const fixed = Number(new URLSearchParams(location.hash.slice(1)).get("size"));  // #size=512
const BUDGET = 0.03;  // seconds of a worker for a picture while things move
const SIDES = {least: 256, most: 1024, step: 32};
const home = {yaw: 0, pitch: 0, zoom: 1};
const look = {...home};
const sliders = [];  // {input, rest, apply(value, parameters, weights)}
let header, target, shown, clip, playing = false, following = false, pointer = [0, 0];
let started = 0, asked = 0, latest = 0, side = 512, restless = 0;
const idle = [], times = [];

main().catch(error => {
  find("error").hidden = false;
  find("error").textContent = `This browser cannot play the avatar: ${error.message}`;
});

async function main() {
  const bytes = Uint8Array.from(atob(find("avatar").textContent), c => c.charCodeAt(0));
  const inflated = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  const buffer = await new Response(inflated).arrayBuffer();
  const length = new DataView(buffer).getUint32(0, true);
  header = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length)));
  clip = header.clip;
  const url = URL.createObjectURL(new Blob([find("splats").textContent]));
  const count = Math.max(1, Math.min(4, navigator.hardwareConcurrency || 2));
  for (let i = 0; i < count; ++i) {
    const worker = new Worker(url);
    worker.onmessage = received;
    worker.postMessage({avatar: buffer});
    idle.push({worker});
  }
  addSliders();
  target = described();
  shown = {parameters: target.parameters.slice(), codes: target.codes.slice()};
  addControls();
  requestAnimationFrame(tick);
}

function addSliders() {
  const group = (name, open) => {
    const details = document.createElement("details");
    details.open = open;
    details.append(Object.assign(document.createElement("summary"), {textContent: name}));
    find("sliders").append(details);
    return details;
  };
  const add = (where, name, [low, high], apply) => {
    const label = document.createElement("label");
    const text = Object.assign(document.createElement("span"), {textContent: name, title: name});
    const input = Object.assign(document.createElement("input"),
      {type: "range", min: low, max: high, step: (high - low) / 200, value: 0, name});
    input.oninput = () => { if (playing) press("play"); target = described(); restless = 0; };
    label.append(text, input);
    where.append(label);
    sliders.push({input, apply});
  };
  const X = header.coefficients.length;
  const faces = group("Expressions", true), poses = group("Jaw, gaze, neck", true);
  header.expressions.forEach((name, e) => add(faces, name.replaceAll("_", " "), [0, 1],
    (value, parameters, weights) => { weights[e] += value; }));
  for (const [name, places, range] of header.poses) add(poses, name, range,
    (value, parameters) => { for (const place of places) parameters[X + place] += value; });
  const more = group("Coefficients", false);
  header.coefficients.forEach((name, x) => add(more, name, header.range,
    (value, parameters) => { parameters[x] += value; }));
}

function mixed(parameters, weights) {  // adds training expressions by their weights
  const codes = new Array(header.codes).fill(0);
  weights.forEach((weight, e) => {
    if (!weight) return;
    header.changes[e].forEach((value, i) => { parameters[i] += weight * value; });
    header.shares[e].forEach((value, k) => { codes[k] += weight * value; });
  });
  return {parameters, codes};
}

function described() {  // the pose that the sliders say
  const parameters = Float32Array.from(header.own);
  const weights = header.expressions.map(() => 0);
  for (const {input, apply} of sliders) {
    const value = Number(input.value);
    if (value) apply(value, parameters, weights);
  }
  return mixed(parameters, weights);
}

function played(seconds) {  // the clip, or without one a tour of the expressions
  if (clip) return mixed(Float32Array.from(clip.frames[Math.floor(seconds * clip.rate) % clip.frames.length]), []);
  const weights = header.expressions.map(() => 0), X = header.coefficients.length;
  const parameters = Float32Array.from(header.own), lasts = 1.8;
  if (weights.length) weights[Math.floor(seconds / lasts) % weights.length] = Math.sin(Math.PI * (seconds % lasts) / lasts) ** 2;
  parameters[X + 1] += 0.12 * Math.sin(0.9 * seconds);
  parameters[X + 3] += 0.06 * (1 - Math.cos(2.3 * seconds));
  for (const eye of [7, 10]) parameters[X + eye] += 0.15 * Math.sin(1.3 * seconds);
  return mixed(parameters, weights);
}

function tick(now) {
  requestAnimationFrame(tick);
  const seconds = (now - started) / 1000, X = header.coefficients.length;
  let goal = playing ? played(seconds) : target;
  if (following) {
    goal = {parameters: goal.parameters.slice(), codes: goal.codes};
    for (const eye of [6, 9]) {
      goal.parameters[X + eye] += 0.3 * pointer[1];
      goal.parameters[X + eye + 1] += 0.4 * pointer[0];
    }
    goal.parameters[X] += 0.1 * pointer[1];
    goal.parameters[X + 1] += 0.2 * pointer[0];
  }
  let moved = playing;
  for (const name of ["parameters", "codes"]) goal[name].forEach((value, i) => {
    const step = value - shown[name][i];
    if (Math.abs(step) > 1e-4) moved = true;
    shown[name][i] = playing && clip ? value : shown[name][i] + 0.4 * step;
  });
  restless = moved ? 0 : restless + 1;
  // A few pictures after the last change, the last of them at full size.
  if (restless > 12 || !idle.length || (restless > 1 && restless < 12)) return;
  const {worker, pixels} = idle.pop();
  const size = fixed || (restless >= 12 ? fullSide() : Math.min(side, fullSide()));
  worker.postMessage({parameters: shown.parameters, codes: shown.codes, camera: camera(size),
                      pixels, number: ++asked, moving: restless < 12}, pixels ? [pixels] : []);
}

function fullSide() {
  const pixels = canvas.clientWidth * devicePixelRatio;
  const whole = SIDES.step * Math.ceil(pixels / SIDES.step);
  return Math.max(SIDES.least, Math.min(SIDES.most, whole));
}

function camera(size) {  // OpenCV axes; the target is in the middle of the picture
  const {target: at, distance, focal} = header.camera;
  const [sy, cy, sp, cp] = [Math.sin(look.yaw), Math.cos(look.yaw), Math.sin(look.pitch), Math.cos(look.pitch)];
  const right = [cy, 0, -sy], back = [sy * cp, sp, cy * cp];
  const down = [sy * sp, -cp, cy * sp];
  const rotation = [...right, ...down, ...back.map(value => -value)];
  const shift = [0, 3, 6].map(r => -(rotation[r] * at[0] + rotation[r + 1] * at[1] + rotation[r + 2] * at[2]));
  shift[2] += distance;
  return {rotation, shift, focal: focal * size * look.zoom, size};
}

function received({target: worker, data}) {
  if (data.number > latest) {  // workers may overtake each other
    latest = data.number;
    if (canvas.width !== data.size) canvas.width = canvas.height = data.size;
    context.putImageData(new ImageData(new Uint8ClampedArray(data.pixels), data.size), 0, 0);
    canvas.dataset.pictures = Number(canvas.dataset.pictures || 0) + 1;
    times.push(performance.now());
    while (times.length > 1 && times[0] < times[times.length - 1] - 1000) times.shift();
    const gap = (times[times.length - 1] - times[0]) / (times.length - 1);
    find("rate").textContent = restless < 12 && times.length > 5 ? `${Math.round(1000 / gap)} frames/s` : "";
    if (data.moving) {  // the side that takes a worker as long as the budget
      const ideal = data.size * Math.sqrt(BUDGET / data.seconds);
      side = Math.max(SIDES.least, Math.min(SIDES.most, SIDES.step * Math.round((0.8 * side + 0.2 * ideal) / SIDES.step)));
    }
  }
  idle.push({worker, pixels: data.pixels});
}

function press(name) {
  if (name === "play") { playing = !playing; started = performance.now(); }
  if (name === "follow") following = !following;
  if (name === "reset") {
    for (const {input} of sliders) input.value = 0;
    Object.assign(look, home);
    playing = following = false;
    target = described();
  }
  find("play").setAttribute("aria-pressed", playing);
  find("follow").setAttribute("aria-pressed", following);
  restless = 0;
}

function turn(dx, dy, zoom = 1) {
  const {yaw, pitch} = header.limits;
  look.yaw = Math.max(yaw[0], Math.min(yaw[1], look.yaw + dx));
  look.pitch = Math.max(pitch[0], Math.min(pitch[1], look.pitch + dy));
  look.zoom = Math.max(0.6, Math.min(4, look.zoom * zoom));
  restless = 0;
}

function addControls() {
  for (const name of ["play", "follow", "reset"]) find(name).onclick = () => press(name);
  const held = new Map();
  const apart = () => { const [a, b] = [...held.values()]; return Math.max(1, Math.hypot(a[0] - b[0], a[1] - b[1])); };
  canvas.onpointerdown = event => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.clientX, event.clientY]);
  };
  canvas.onpointerup = canvas.onpointercancel = event => held.delete(event.pointerId);
  canvas.onpointermove = event => {
    const last = held.get(event.pointerId), here = [event.clientX, event.clientY];
    if (!last) return;
    const before = held.size === 2 ? apart() : 0;
    held.set(event.pointerId, here);
    if (held.size === 2) turn(0, 0, apart() / before);
    else turn(-0.008 * (here[0] - last[0]), 0.008 * (here[1] - last[1]));
  };
  canvas.addEventListener("wheel", event => {
    event.preventDefault();
    turn(0, 0, 1.001 ** -event.deltaY);
  }, {passive: false});
  addEventListener("pointermove", event => {
    const box = canvas.getBoundingClientRect();
    pointer = [(event.clientX - box.x) / box.width, (event.clientY - box.y) / box.height]
      .map(value => Math.max(-1, Math.min(1, 2 * value - 1)));
    if (following) restless = 0;
  });
  addEventListener("resize", () => { restless = 0; });
  const steps = {ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1],
                 "+": [0, 0, 1.1], "=": [0, 0, 1.1], "-": [0, 0, 1 / 1.1]};
  addEventListener("keydown", event => {
    if (["INPUT", "BUTTON", "SUMMARY"].includes(event.target.tagName)) return;
    if (event.key === " ") press("play");
    else if (steps[event.key]) turn(...steps[event.key]);
    else return;
    event.preventDefault();
  });
}
