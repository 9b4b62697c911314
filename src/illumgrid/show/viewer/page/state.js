// The state of the page, and its form in the address.

export const DEFAULTS = { sweep: 0.5, light: "global", split: 0.5, stops: 0, look: "matte", trust: false, rest: true, turn: [0, 0], clip: [-1, 0.5], tint: true };

export const AXES = ["x", "y", "z", "-x", "-y", "-z"];
const short = (x) => String(Number(x.toPrecision(6)));
export const clamp = (x, low, high) => Math.min(high, Math.max(low, x));
export const sweepOf = ({ sweep: [first, last] }, isovalue) => (first === last ? 0.5 : clamp((isovalue - first) / (last - first), 0, 1));
export const lead = (scene) => scene.fields[scene.lead]; // the first field that is not held at one level
export const isovalueOf = (field, sweep) => (1 - sweep) * field.sweep[0] + sweep * field.sweep[1];

// "isovalue=0.45&view=0.52,0.31,4.1,0,0,0&light=both": only what differs from the opened page.
export function written(state, scene) {
  const parts = [`isovalue=${String(Number(isovalueOf(lead(scene), state.sweep).toPrecision(9)))}`];
  if (state.view.moved) {
    const { azimuth, elevation, distance, target } = state.view;
    parts.push(`view=${[azimuth, elevation, distance, ...target].map(short).join(",")}`);
  }
  if (state.light !== DEFAULTS.light) parts.push(`light=${state.light}`);
  if (state.light === "both") parts.push(`split=${short(state.split)}`);
  if (state.look !== DEFAULTS.look) parts.push(`look=${state.look}`);
  if (state.stops) parts.push(`stops=${short(state.stops)}`);
  if (state.trust) parts.push("trust=1");
  if (!state.rest) parts.push("rest=0");
  if (state.clip[0] >= 0) parts.push(`clip=${AXES[state.clip[0]]},${short(state.clip[1])}`);
  if (!state.tint) parts.push("tint=0");
  if (String(state.turn) !== String(DEFAULTS.turn)) parts.push(`turn=${state.turn.map(short).join(",")}`);
  if (scene.lights.some(({ weight }, k) => weight !== state.weights[k])) parts.push(`weights=${state.weights.map(short).join(",")}`);
  return parts.join("&");
}

// The part of a state that an address holds; invalid values are ignored.
export function read(address, scene, looks) {
  const given = new URLSearchParams(address), state = {};
  const number = (name) => (given.has(name) && given.get(name) !== "" && Number.isFinite(Number(given.get(name))) ? Number(given.get(name)) : null);
  if (number("isovalue") !== null) state.sweep = sweepOf(lead(scene), number("isovalue"));
  const view = (given.get("view") ?? "").split(",").map(Number);
  if (view.length === 6 && view.every(Number.isFinite) && view[2] > 0) {
    state.view = { azimuth: view[0], elevation: clamp(view[1], -1.5533, 1.5533), distance: view[2], target: view.slice(3), moved: true };
  }
  const turn = (given.get("turn") ?? "").split(",").map(Number);
  if (scene.sky && turn.length === 2 && turn.every(Number.isFinite)) state.turn = turn;
  const weights = (given.get("weights") ?? "").split(",").map(Number);
  if (given.get("weights") && weights.length === scene.lights.length && weights.every(Number.isFinite)) state.weights = weights;
  if (["global", "local", "both"].includes(given.get("light"))) state.light = given.get("light");
  if (looks.includes(given.get("look"))) state.look = given.get("look");
  if (number("split") !== null) state.split = clamp(number("split"), 0, 1);
  if (number("stops") !== null) state.stops = clamp(number("stops"), -3, 3);
  if (given.get("trust") === "1") state.trust = true;
  if (given.get("rest") === "0") state.rest = false;
  if (given.get("tint") === "0") state.tint = false;
  const [axis, place] = (given.get("clip") ?? "").split(",");
  if (AXES.includes(axis) && Number.isFinite(Number(place))) state.clip = [AXES.indexOf(axis), clamp(Number(place), 0, 1)];
  return state;
}
