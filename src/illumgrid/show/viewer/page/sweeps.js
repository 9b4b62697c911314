// The isovalue sliders, each over the histogram of its field.

import { isovalueOf, sweepOf } from "./state.js";

export function formatted(field, isovalue) {
  const span = field.range[1] - field.range[0];
  const digits = Math.ceil(-Math.log10(span / 400));
  return digits > 8 || span > 1e7 ? isovalue.toPrecision(5) : isovalue.toFixed(Math.max(0, digits));
}

function bars(counts, from, to, highest) {
  let path = "";
  counts.forEach((count, k) => {
    const middle = (k + 0.5) / counts.length;
    if (count && middle >= from && middle <= to) {
      const height = Math.max(1.5, Math.min(100, 100 * Math.sqrt(count / highest))); // the root keeps a peak of background from hiding the rest
      path += `M${k} 100V${(100 - height).toFixed(1)}h1V100z`;
    }
  });
  return path;
}

export function element(kind, attributes = {}, children = []) {
  const made = document.createElement(kind);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

function sweep(field, number, many, put) {
  const { counts, limits: [low, high] } = field.histogram;
  const from = (field.range[0] - low) / (high - low), to = (field.range[1] - low) / (high - low);
  const name = `Isovalue of ${field.name}`;
  const typed = element("input", { type: "number", step: "any", "aria-label": `${name}, typed`, inputmode: "decimal" });
  const slider = element("input", { type: "range", min: field.range[0], max: field.range[1], step: "any", "aria-label": name });
  slider.style.left = `calc(${100 * from}% - 10px)`;
  slider.style.width = `calc(${100 * (to - from)}% + 20px)`;
  const highest = 1.2 * Math.max(1, ...counts.filter((_, k) => (k + 1) / counts.length > from && k / counts.length < to));
  const drawn = [["", -1, 2], ["baked", from, to]].map(([kind, a, b]) => `<path class="${kind}" d="${bars(counts, a, b, highest)}"/>`);
  const histogram = element("div", { class: "histogram" });
  histogram.innerHTML = `<svg viewBox="0 0 ${counts.length} 100" preserveAspectRatio="none" aria-hidden="true">${drawn.join("")}</svg>`;
  const band = element("div", { class: "band" });
  band.style.left = `${100 * from}%`;
  band.style.width = `${100 * (to - from)}%`;
  histogram.append(band, slider);
  const ends = field.range.map((end, k) => {
    const label = element("span", {}, [formatted(field, end)]);
    label.style.left = `${100 * (k ? to : from)}%`;
    return label;
  });
  const dot = element("i");
  dot.style.background = field.swatch;
  const label = element("label", {}, many ? [dot, field.name] : ["Isovalue"]);
  const box = element("div", { class: "sweep", title: `The light was computed for isovalues from ${formatted(field, field.range[0])} to ${formatted(field, field.range[1])}` }, [
    element("div", { class: "head" }, [label, typed]),
    histogram,
    element("div", { class: "limits", "aria-hidden": "true" }, ends),
  ]);
  slider.addEventListener("input", () => put(sweepOf(field, Number(slider.value))));
  typed.addEventListener("change", () => {
    if (typed.value !== "" && Number.isFinite(Number(typed.value))) put(sweepOf(field, Number(typed.value)));
    typed.value = slider.getAttribute("aria-valuetext");
  });
  const show = (share) => {
    const isovalue = isovalueOf(field, share), text = formatted(field, isovalue);
    if (Math.abs(Number(slider.value) - isovalue) > 1e-9 * (field.range[1] - field.range[0])) slider.value = isovalue;
    slider.setAttribute("aria-valuetext", text);
    typed.value = text;
  };
  return { box, show };
}

// A field whose level does not sweep.
function fixed(field) {
  const dot = element("i");
  dot.style.background = field.swatch;
  return { box: element("div", { class: "sweep" }, [element("div", { class: "head" }, [element("label", {}, [dot, `${field.name}, held at ${Number(field.sweep[0].toPrecision(4))}`])])]), show: () => {} };
}

// Fills `place`; returns a function that shows a position (0 to 1) of the common sweep on all sliders.
export function sweeps(place, fields, put) {
  const made = fields.map((field, k) => (field.sweep[0] === field.sweep[1] ? fixed(field) : sweep(field, k, fields.length > 1, put)));
  place.replaceChildren(...made.map((m) => m.box));
  return (share) => made.forEach((m) => m.show(share));
}
