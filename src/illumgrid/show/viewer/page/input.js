// Mouse, touch and keys on the picture change the view.

import { orbited, panned, zoomed } from "./camera.js";

const TURN = Math.PI; // radians for a drag over the picture's height

export function listen(canvas, scene, get, put, reset) {
  const held = new Map();
  let spread = null;
  const pan = (x, y) => put(panned(get(), scene.axes, scene.tangent, x, y));
  const middle = () => [...held.values()].reduce(([x, y], p) => [x + p[0] / held.size, y + p[1] / held.size], [0, 0]);
  const spacing = () => {
    const [a, b] = [...held.values()];
    return held.size === 2 ? Math.hypot(a[0] - b[0], a[1] - b[1]) : null;
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    held.set(event.pointerId, [event.clientX, event.clientY]);
    spread = spacing();
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!held.has(event.pointerId)) return;
    const before = middle();
    held.set(event.pointerId, [event.clientX, event.clientY]);
    const after = middle(), height = canvas.clientHeight;
    const [x, y] = [after[0] - before[0], after[1] - before[1]];
    if (held.size === 2) {
      pan((2 * x) / height, (-2 * y) / height);
      const now = spacing();
      if (now > 0 && spread > 0) put(zoomed(get(), spread / now));
      spread = now;
    } else if (event.shiftKey || event.buttons & 6) pan((2 * x) / height, (-2 * y) / height);
    else put(orbited(get(), (-TURN * x) / height, (TURN * y) / height));
  });
  for (const name of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(name, (event) => {
      held.delete(event.pointerId);
      spread = spacing();
    });
  }
  const alone = canvas.getRootNode() === document && globalThis.top === globalThis.self;
  canvas.addEventListener("wheel", (event) => {
    if (!alone && !canvas.matches(":focus")) return; // in an embedding page, scrolling continues until the picture is clicked
    event.preventDefault();
    put(zoomed(get(), Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY * (event.deltaMode ? 0.05 : 0.0015))))));
  }, { passive: false });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("dblclick", reset);
  canvas.addEventListener("keydown", (event) => {
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] };
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (arrows[event.key]) {
      const [x, y] = arrows[event.key];
      if (event.shiftKey) pan(0.08 * x, 0.08 * y);
      else put(orbited(get(), 0.09 * x, 0.09 * y));
    } else if (event.key === "+" || event.key === "=") put(zoomed(get(), 1 / 1.12));
    else if (event.key === "-") put(zoomed(get(), 1.12));
    else if (event.key === "0" || event.key === "Home") reset();
    else return;
    event.preventDefault();
  });
}

// A line dragged along the picture; `put` receives its share of the width.
export function listenSplit(handle, stage, get, put) {
  const follow = (event) => {
    const box = stage.getBoundingClientRect();
    put((event.clientX - box.left) / box.width);
  };
  handle.addEventListener("pointerdown", (event) => {
    handle.setPointerCapture(event.pointerId);
    event.preventDefault();
    handle.focus({ focusVisible: false });
  });
  handle.addEventListener("pointermove", (event) => {
    if (handle.hasPointerCapture(event.pointerId)) follow(event);
  });
  handle.addEventListener("keydown", (event) => {
    const to = { ArrowLeft: get() - 0.02, ArrowDown: get() - 0.02, ArrowRight: get() + 0.02, ArrowUp: get() + 0.02, Home: 0, End: 1 }[event.key];
    if (to === undefined) return;
    event.preventDefault();
    put(to);
  });
}
