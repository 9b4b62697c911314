// The page: a state, the picture of it, and the controls that change it.

import { fitted } from "./camera.js";
import { listen, listenSplit } from "./input.js";
import { lights } from "./lights.js";
import { live } from "./live.js";
import { LOOKS, Picture } from "./picture.js";
import { PLACES, Resting } from "./resting.js";
import { skyBall } from "./skies.js";
import { AXES, DEFAULTS, clamp, isovalueOf, lead, read, written } from "./state.js";
import { formatted, sweeps } from "./sweeps.js";

const REST = 160; // milliseconds without a change until a full frame is drawn
const SMOOTH = 30; // milliseconds per frame during interaction
const QUICK = 60; // frames faster than this are refined beyond the four samples of a still picture

// Runs the view in `root`, which holds the markup. Options: address (keep the state in it), onChange (called with the state),
// get (gets light that is still being computed).
export function view(root, scene, data, shaders, { address = true, onChange = () => {}, get } = {}) {
  const part = (name) => root.querySelector(`[data-part="${name}"]`);
  const canvas = part("canvas"), stage = part("stage");
  const picture = new Picture(canvas, scene, data, shaders);
  let resting = Resting.of(picture, shaders, data);
  const opened = { ...DEFAULTS, weights: scene.lights.map((light) => light.weight) }, state = { ...opened };
  let changed = -Infinity, samples = 0, coarse = 2, asked = false, written_ = "", fresh = true, rests = false;

  const aspect = () => Math.max(stage.clientWidth, 1) / Math.max(stage.clientHeight, 1);
  const whole = () => ({ ...fitted(scene.opening, scene.axes, aspect(), scene.tangent), moved: false });
  state.view = whole();

  const show = sweeps(part("sweeps"), scene.fields, (sweep) => put({ sweep }));
  const weigh = lights(part("lights"), scene.lights, () => state.weights, (weights) => put({ weights }));

  const ball = skyBall(part("ball"), scene, () => state.turn, (turn) => put({ turn }));

  function controls() {
    show(state.sweep);
    weigh(state.weights);
    ball(state.turn, state.view);
    part("opened").hidden = String([state.weights, state.turn]) === String([opened.weights, opened.turn]);
    for (const choice of root.querySelectorAll("[data-choice]")) {
      const kind = choice.dataset.choice;
      for (const input of choice.querySelectorAll("input")) input.checked = input.value === state[kind];
    }
    part("effect").hidden = state.look === "matte";
    const [axis, at] = state.clip, { low, high, middle, size } = scene.clip, cut = middle[axis % 3] + size * ((1 - at) * low[axis % 3] + at * high[axis % 3]);
    part("clip").value = axis;
    part("clipLine").hidden = part("clipNote").hidden = axis < 0;
    part("clipPlace").value = at;
    part("clipShown").value = axis < 0 ? "" : cut.toPrecision(4);
    part("tint").checked = state.tint;
    part("colors").hidden = !scene.tint;
    part("stops").value = state.stops;
    part("stopsShown").value = `${state.stops > 0 ? "+" : state.stops < 0 ? "\u2212" : "\u00b1"}${Math.abs(state.stops).toFixed(1)} EV`;
    part("trust").checked = state.trust;
    part("rest").checked = state.rest;
    part("refine").hidden = !resting;
    part("legend").hidden = !state.trust;
    part("split").hidden = state.light !== "both" || state.trust;
    part("split").style.left = `${100 * state.split}%`;
    part("split").setAttribute("aria-valuenow", Math.round(100 * state.split));
    const isovalues = scene.fields.map((f) => `${f.name} at ${formatted(f, isovalueOf(f, state.sweep))}`).join(", ");
    canvas.setAttribute("aria-label", `Isosurface of ${isovalues}, ${state.light} light`);
  }

  function put(part_) {
    Object.assign(state, part_);
    state.sweep = clamp(state.sweep, 0, 1);
    state.split = clamp(state.split, 0, 1);
    changed = performance.now();
    samples = 0;
    rests = false;
    controls();
    draw();
    onChange(state);
  }

  function draw(busy = true) {
    if (busy) canvas.setAttribute("aria-busy", "true");
    if (!asked) requestAnimationFrame(frame);
    asked = true;
  }

  function size() {
    const scale = Math.min(globalThis.devicePixelRatio || 1, 2);
    const [width, height] = [stage.clientWidth, stage.clientHeight].map((n) => Math.max(1, Math.round(n * scale)));
    if (canvas.width !== width || canvas.height !== height) {
      canvas.width = width;
      canvas.height = height;
      if (!state.view.moved) state.view = whole();
      samples = 0;
      rests = false;
    }
  }

  function frame() {
    asked = false;
    size();
    if (rests) {
      rest();
      return;
    }
    picture.mix(state);
    const moving = !fresh && performance.now() - changed < REST;
    const begun = performance.now(), divide = moving ? coarse : 1;
    picture.sample(state, Math.ceil(canvas.width / divide), Math.ceil(canvas.height / divide), moving ? [0.5, 0.5] : PLACES[samples], moving ? 0 : samples);
    picture.show();
    picture.wait();
    const took = performance.now() - begun;
    view_.took = took;
    if (moving) {
      if (took > SMOOTH && coarse < 6) coarse += 1;
      else if (took < SMOOTH / 3 && coarse > 1) coarse -= 1;
      draw();
      return;
    }
    samples += 1;
    fresh = false;
    if (samples < 4 || (samples < PLACES.length && took < QUICK)) draw();
    else still();
  }

  // Gathers light while nothing changes; browsers request no frames of hidden pages.
  function rest() {
    if (!resting.done) resting.step(state);
    resting.show(state.stops);
    picture.wait();
    part("rays").value = `${resting.rays} rays per pixel`;
    if (!resting.done) draw(false);
  }

  function still() {
    rests = resting && state.rest && state.light === "global" && !state.trust;
    part("rays").value = "";
    if (rests) {
      try {
        resting.begin(state, canvas.width, canvas.height, view_.took);
        draw(false);
      } catch (error) {  // a driver may refuse the shaders of rays only: lookups go on
        console.warn(error.message);
        resting = null;
        rests = false;
        part("refine").hidden = true;
      }
    }
    canvas.setAttribute("aria-busy", "false");
    if (!address) return;
    written_ = written(state, scene);
    try {
      history.replaceState(null, "", `#${written_}`);
    } catch { /* a frame without an address of its own */ }
  }

  function follow() {
    if (location.hash.slice(1) !== written_) put({ ...opened, view: whole(), ...read(location.hash.slice(1), scene, LOOKS) });
  }

  function save() {
    if (rests) resting.show(state.stops);
    else picture.show();
    canvas.toBlob((blob) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      const isovalue = formatted(lead(scene), isovalueOf(lead(scene), state.sweep));
      link.download = `${scene.fields.map((f) => f.name).join("-").replace(/[^\p{L}\p{N}.-]+/gu, "_")}-${isovalue}.png`;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 1000);
    });
  }

  const reset = () => put({ view: whole() });
  listen(canvas, scene, () => state.view, (next) => put({ view: { ...next, moved: true } }), reset);
  listenSplit(part("split"), stage, () => state.split, (split) => put({ split }));
  for (const choice of root.querySelectorAll("[data-choice]")) {
    choice.addEventListener("change", (event) => put({ [choice.dataset.choice]: event.target.value }));
  }
  part("stops").addEventListener("input", () => put({ stops: Number(part("stops").value) }));
  part("trust").addEventListener("change", () => put({ trust: part("trust").checked }));
  for (const name of ["clip", "clipPlace"]) {
    part(name).addEventListener("input", () => put({ clip: [Number(part("clip").value), Number(part("clipPlace").value)] }));
  }
  part("clip").replaceChildren(new Option("nothing", -1), ...AXES.map((axis, k) => new Option(`${axis.length > 1 ? "before" : "beyond"} ${axis.at(-1)}`, k)));
  if (scene.fields.some((field) => field.through > 0 || (field.rough ?? -1) >= 0)) part("own").textContent = "Own";
  if (scene.tint) {
    part("tintName").textContent = scene.tint.name;
    scene.tint.ends.forEach((end, k) => (part(k ? "tintMost" : "tintLeast").textContent = Number(end.toPrecision(4))));
    part("tintScale").style.background = `linear-gradient(90deg, ${scene.tint.colors.join(", ")})`;
    part("tint").addEventListener("change", () => put({ tint: part("tint").checked }));
  }
  part("rest").addEventListener("change", () => put({ rest: part("rest").checked }));
  part("reset").addEventListener("click", reset);
  part("save").addEventListener("click", save);
  canvas.addEventListener("webglcontextlost", () => complain(root, "The graphics card was reset. Reload the page to continue."));
  part("title").textContent = scene.title;
  part("subtitle").textContent = scene.subtitle;
  const [least, most] = scene.trust.ends.map((end) => `${Number((100 * end).toPrecision(2))} %`);
  part("least").textContent = `< ${least}`;
  part("most").textContent = `> ${most}`;
  part("legend").style.setProperty("--scale", `linear-gradient(90deg, ${scene.trust.colors.join(", ")})`);
  part("notes").replaceChildren(...scene.notes.map((text) => Object.assign(document.createElement("p"), { textContent: text })));
  new ResizeObserver(draw).observe(stage);
  const view_ = { state, put, picture, resting, took: 0 };
  if (address) {
    Object.assign(state, read(location.hash.slice(1), scene, LOOKS));
    globalThis.addEventListener("hashchange", follow);
  }
  controls();
  draw();
  const renew = () => {
    samples = 0;
    rests = false;
    draw();
  };
  if (scene.live) live(picture, scene, state, aspect, (text) => { part("subtitle").textContent = text; }, renew, get);
  return view_;
}

// Shows a sentence in place of the picture.
export function complain(root, sentence) {
  const place = root.querySelector('[data-part="message"]');
  place.textContent = sentence;
  place.hidden = false;
}
