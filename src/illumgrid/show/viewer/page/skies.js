// A smooth sky in spherical harmonics, a ball that shows it, and the controls that turn it: see illumgrid.field.lights.

import { facing, sum } from "./camera.js";
import { element } from "./sweeps.js";

const BALL = 96; // pixels
const COSINE = [1, 2 / 3, 1 / 4, 0, -1 / 24]; // factor of each degree in the light of a diffuse surface (Ramamoorthi and Hanrahan 2001)
const HEIGHTS = [[0, 0.5688888889], [0.5384693101, 0.4786286705], [0.9061798459, 0.2369268851]]; // Gauss-Legendre quadrature

function basis([x, y, z], count) {
  const xx = x * x, yy = y * y, zz = z * z;
  return [
    0.2820947918, 0.4886025119 * y, 0.4886025119 * z, 0.4886025119 * x,
    1.0925484306 * x * y, 1.0925484306 * y * z, 0.3153915653 * (3 * zz - 1), 1.0925484306 * x * z, 0.5462742153 * (xx - yy),
    0.5900435899 * y * (3 * xx - yy), 2.8906114426 * x * y * z, 0.4570457995 * y * (5 * zz - 1), 0.3731763326 * z * (5 * zz - 3),
    0.4570457995 * x * (5 * zz - 1), 1.4453057213 * z * (xx - yy), 0.5900435899 * x * (xx - 3 * yy),
    2.503342942 * x * y * (xx - yy), 1.7701307698 * y * z * (3 * xx - yy), 0.9461746958 * x * y * (7 * zz - 1),
    0.6690465436 * y * z * (7 * zz - 3), 0.1057855469 * (35 * zz * zz - 30 * zz + 3), 0.6690465436 * x * z * (7 * zz - 3),
    0.4730873479 * (xx - yy) * (7 * zz - 1), 1.7701307698 * x * z * (xx - 3 * yy), 0.6258357354 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
  ].slice(0, count);
}

const seen = (coefficients, functions) => [0, 1, 2].map((j) => functions.reduce((s, f, b) => s + f * coefficients[b][j], 0));

// Coefficients of the sky tilted by degrees from back to up, then turned from back to right, by exact quadrature.
export function skyTurned(coefficients, [turn, tilt]) {
  const [a, b] = [turn, tilt].map((degrees) => (degrees * Math.PI) / 180), count = coefficients.length;
  const made = coefficients.map(() => [0, 0, 0]);
  if (!turn && !tilt) return coefficients;
  for (const [height, weight] of HEIGHTS) {
    for (let k = 0; k < (height ? 20 : 10); k++) {
      const azimuth = (k % 10) * (Math.PI / 5), z = k < 10 ? height : -height, level = Math.sqrt(1 - z * z);
      const d = [level * Math.cos(azimuth), level * Math.sin(azimuth), z];
      const back = d[0] * Math.sin(a) + d[1] * Math.cos(a);
      const before = [d[0] * Math.cos(a) - d[1] * Math.sin(a), back * Math.cos(b) + z * Math.sin(b), z * Math.cos(b) - back * Math.sin(b)];
      const light = seen(coefficients, basis(before, count));
      basis(d, count).forEach((f, i) => light.forEach((c, j) => (made[i][j] += weight * (Math.PI / 5) * f * c)));
    }
  }
  return made;
}

// Fills `place` with the ball; returns a function that draws a turn of the sky as seen from a view.
export function skyBall(place, scene, get, put) {
  if (!scene.sky) return () => {};
  const canvas = element("canvas", { width: BALL, height: BALL, tabindex: 0, role: "slider", "aria-label": "Turn of the sky, degrees", "aria-valuemin": -180, "aria-valuemax": 180 });
  const reset = element("button", { type: "button" }, ["Reset sky"]);
  place.append(canvas, element("p", { class: "note" }, ["A white ball under this sky. Drag it, or use its arrow keys, to turn the light."]), reset);
  place.hidden = false;
  const round = (x) => ((((x + 180) % 360) + 360) % 360) - 180, by = (x, y) => put([round(get()[0] + x), Math.max(-90, Math.min(90, get()[1] + y))]);
  reset.addEventListener("click", () => put([0, 0]));
  canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    if (event.buttons) by((180 * event.movementX) / BALL, (-180 * event.movementY) / BALL);
  });
  canvas.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5], Home: get().map((x) => -x) }[event.key];
    if (!step) return;
    event.preventDefault();
    by(...step);
  });
  const ink = canvas.getContext("2d"), picture = ink.createImageData(BALL, BALL);
  let shown = "";
  return (turn, view) => {
    if (shown === (shown = JSON.stringify([turn, view]))) return;
    canvas.setAttribute("aria-valuenow", Math.round(turn[0]));
    const kept = skyTurned(scene.sky.coefficients, turn).map((c, b) => c.map((x) => x * COSINE[Math.floor(Math.sqrt(b))]));
    const { right, up, forward } = facing(view, scene.axes);
    const [x, y, z] = [right, up, forward].map((v) => scene.sky.axes.map((axis) => axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2]));
    for (let i = 0; i < BALL * BALL; i++) {
      const u = (2 * (i % BALL) + 1) / BALL - 1, v = 1 - (2 * Math.floor(i / BALL) + 1) / BALL, r = u * u + v * v;
      const light = r < 1 ? seen(kept, basis(sum([u, x], [v, y], [-Math.sqrt(1 - r), z]), kept.length)) : [0, 0, 0];
      light.forEach((c, j) => (picture.data[4 * i + j] = 255 * Math.min(1, Math.max(0, scene.white * scene.sky.exposure * c)) ** (1 / 2.2)));
      picture.data[4 * i + 3] = 255 * Math.max(0, Math.min(1, ((1 - Math.sqrt(r)) * BALL) / 2));
    }
    ink.putImageData(picture, 0, 0);
  };
}
