// The same view in a notebook: the traits of the anywidget model and the view follow each other.

import { inflate } from "./numbers.js";
import { isovalueOf, lead, sweepOf } from "./state.js";
import { complain, view } from "./view.js";

// Gets the kernel's answer to a request by messages; `left` says whether the view is gone.
const asking = (model, left) => (question) => new Promise((done, fail) => {
  const number = Math.random();
  const hear = (said, buffers) => {
    if (said.number !== number) return;
    model.off("msg:custom", hear);
    const [held] = buffers ?? [];
    if (held && !left()) done(held.buffer.slice(held.byteOffset, held.byteOffset + held.byteLength));
    else fail(new Error(said.problem));
  };
  model.on("msg:custom", hear);
  model.send({ number, question });
});

async function render({ model, el }) {
  let gone = false;
  const place = document.createElement("div");
  place.style.cssText = `height: ${model.get("height")}px; container-type: inline-size`;
  el.append(place);
  const root = place.attachShadow({ mode: "open" });
  root.innerHTML = `<style>${model.get("_style")}</style>${model.get("_markup")}`;
  try {
    const scene = JSON.parse(model.get("_scene")), held = model.get("_data");
    const data = await inflate(new Uint8Array(held.buffer, held.byteOffset, held.byteLength));
    const [low, high] = lead(scene).range;
    const isovalue = (sweep) => isovalueOf(lead(scene), sweep);
    const given = () => scene.lights.map(({ name, weight }) => model.get("weights")[name] ?? weight);
    const near = (a, b) => Math.abs(a - b) < 1e-9 * (high - low);
    const agree = (state) => near(model.get("isovalue"), isovalue(state.sweep)) && String(given()) === String(state.weights);
    const shown = view(root, scene, data, JSON.parse(model.get("_shaders")), {
      address: false,
      get: asking(model, () => gone),
      onChange: (state) => {
        if (agree(state)) return;
        if (!near(model.get("isovalue"), isovalue(state.sweep))) model.set("isovalue", isovalue(state.sweep));
        if (String(given()) !== String(state.weights)) model.set("weights", Object.fromEntries(scene.lights.map(({ name }, k) => [name, state.weights[k]])));
        model.save_changes();
      },
    });
    const follow = () => {
      if (!agree(shown.state)) shown.put({ sweep: sweepOf(lead(scene), model.get("isovalue")), weights: given() });
    };
    for (const trait of ["isovalue", "weights"]) model.on(`change:${trait}`, follow);
    follow();
    return () => {
      gone = true;
      ["isovalue", "weights"].forEach((trait) => model.off(`change:${trait}`, follow));
    };
  } catch (error) {
    complain(root, error.message);
  }
}

export default { render };
