// One slider for each light of a run that keeps several apart.

import { element } from "./sweeps.js";

// Fills `place`; returns a function that shows weights on the sliders.
export function lights(place, known, get, put) {
  const made = known.map(({ name, weight }, k) => {
    const ends = { min: Math.min(0, 2 * weight), max: Math.max(3, 2 * weight) };
    const slider = element("input", { type: "range", ...ends, step: 0.05 }), shown = element("output");
    slider.addEventListener("input", () => put(get().map((old, j) => (j === k ? Number(slider.value) : old))));
    place.append(element("label", { class: "line" }, [element("span", {}, [name]), slider, shown]));
    return (now) => {
      slider.value = now;
      shown.value = `\u00d7 ${now.toFixed(2)}`;
    };
  });
  return (weights) => made.forEach((show, k) => show(weights[k]));
}
