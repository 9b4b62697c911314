// While nothing moves, rays from every pixel gather light; see gather.glsl. A ray ends at the
// surface that it hits, in the light stored there, so that few suffice; where that light is unreliable or the surface
// near, it is reflected once more. Until there are enough rays, the picture is mostly that of the lookup.

import { dot, sum } from "./camera.js";
import { skyTexels } from "./numbers.js";
import { LOOKS } from "./picture.js";
import { program, set } from "./programs.js";
import { skyTurned } from "./skies.js";

export const PLACES = [[0.25, 0.25], [0.75, 0.75], [0.75, 0.25], [0.25, 0.75]].concat( // within the pixel: the four of a still picture, then others between
  [...Array(12).keys()].map((k) => [(0.5 + 0.7548776 * (k + 1)) % 1, (0.5 + 0.5698403 * (k + 1)) % 1]),
);
const MOST = 4096; // rays from each pixel
const FINE = 1 / 500; // standard error, in display radiance, at which the picture is done
const TRIAL = [96, 72], RAYS = 8; // pixels, and rays from each in either half of a trial
const ENOUGH = 64; // pixels from which a surface gets weights of its own
const BAND = 30; // milliseconds per band of a slow picture
const FAR = 100;
const ALIKE = 0.3; // as in illumgrid.grid.cache
const OPEN = 0, DISC = 1, LAMP = 2, MIRROR = 3, IMAGE = 4;
const ROBERTS_2 = [0.7548776662466927, 0.5698402909980532], ROBERTS_4 = [0.8566748838545029, 0.6287067210378087]; // Roberts' sequences of two and four dimensions
const SHINY = 0.35; // roughness of the shiny look

// Sum of variances, each limited to FAR times the median.
function usualOf(known) {
  const most = FAR * (known.sort((a, b) => a - b)[known.length >> 1] || Infinity);
  return known.reduce((total, x) => total + Math.min(x, most), 0);
}

export class Resting {
  // Null if the page cannot: it has no description of the lights, or the graphics card draws no single precision.
  static of(picture, shaders, data) {
    return picture.scene.resting && picture.single ? new Resting(picture, shaders, data) : null;
  }

  constructor(picture, shaders, data) {
    Object.assign(this, { picture, shaders, data, gl: picture.gl, scene: picture.scene, key: "", size: "" });
    this.surfaces = [...this.scene.fields, ...this.scene.walls];
    this.trial = this.targets(...TRIAL);
  }

  // Compiled when rays begin, so that the first picture need not wait.
  get programs() {
    return (this.made ??= this.make());
  }

  make() {
    const { gl, shaders } = this, shared = shaders["shared.glsl"], march = shared + shaders["march.glsl"], ray = shaders["ray.vert"];
    return {
      origin: program(gl, ray, march + shaders["origin.frag"]),
      originWall: program(gl, shaders["wall.vert"], shared + shaders["origin_wall.frag"]),
      sky: program(gl, ray, shared + shaders["gather.glsl"] + shaders["gather_sky.frag"]),
      field: program(gl, ray, march + shaders["gather.glsl"] + shaders["gather.frag"]),
      wall: program(gl, ray, shared + shaders["gather.glsl"] + shaders["gather_wall.frag"]),
      blend: program(gl, ray, shaders["blend.frag"]),
      show: program(gl, ray, shared + shaders["rest.frag"]),
    };
  }

  targets(width, height) {
    const { gl, picture } = this, single = gl.RGBA32F;
    return {
      width, height,
      origin: picture.target(width, height, true, [single, single, gl.RGBA16F]),
      ray: picture.target(width, height, true, [gl.RGBA16F, single, single]),
      onward: picture.target(width, height, true),
      found: picture.target(width, height, false),
      mirror: picture.target(width, height, false),
      means: [0, 1].map(() => picture.target(width, height, false, [single, single])),
    };
  }

  // Starts again for `state`, unless only the exposure has changed; a frame of lookups takes `took` milliseconds.
  begin(state, width, height, took) {
    const { picture } = this, size = String([width, height]);
    if (this.size !== size) {
      if (this.whole) [this.whole.origin, this.whole.ray, this.whole.onward, this.whole.found, this.whole.mirror, ...this.whole.means, this.raw, this.colors].forEach((old) => picture.drop(old));
      Object.assign(this, { size, whole: this.targets(width, height), raw: picture.target(width, height, false), colors: picture.target(width, height, false), key: "" });
    }
    const places = PLACES.slice(0, 4);
    places.forEach((place, k) => picture.sample(state, width, height, place, k, this.raw));
    this.tinted = this.scene.tint && state.tint;
    if (this.tinted) places.forEach((place, k) => picture.sample(state, width, height, place, k, this.colors, true));
    const key = JSON.stringify([size, state.view, state.sweep, state.weights, state.turn, state.look, state.clip, state.tint]);
    if (key === this.key) return;
    this.key = key;
    this.paint(state);
    this.bands = Array(Math.max(1, Math.min(32, Math.ceil((3 * took) / BAND)))).fill(0);
    this.next = 0;
    this.judge(state);
  }

  get rays() {
    return Math.min(...this.bands);
  }

  get done() {
    return this.rays >= this.enough;
  }

  // Traces one more ray from every pixel of the next band.
  step(state) {
    const { gl } = this;
    gl.enable(gl.SCISSOR_TEST);
    this.scissor(this.next);
    this.gather(this.whole, state, this.bands[this.next], PLACES[this.bands[this.next] % PLACES.length], false);
    this.bands[this.next] += 1;
    this.next = (this.next + 1) % this.bands.length;
    gl.disable(gl.SCISSOR_TEST);
  }

  scissor(band) {
    const { width, height } = this.whole, [low, high] = [band, band + 1].map((k) => Math.round((k * height) / this.bands.length));
    this.gl.scissor(0, low, width, high - low);
  }

  show(stops) {
    const { gl, picture } = this, { built } = this.programs.show;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, this.whole.width, this.whole.height);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.enable(gl.SCISSOR_TEST);
    gl.useProgram(built);
    this.bands.forEach((rays, band) => {
      this.scissor(band);
      set(gl, this.programs.show, {
        uStill: picture.bind(0, gl.TEXTURE_2D, picture.mean.color), uLinear: picture.bind(1, gl.TEXTURE_2D, this.raw.color),
        uMean: picture.bind(2, gl.TEXTURE_2D, this.whole.means[rays % 2].color), uCoat: picture.bind(3, gl.TEXTURE_2D, this.whole.means[rays % 2].colors[1]),
        uColors: picture.bind(4, gl.TEXTURE_2D, this.colors.color), uTint: this.tinted ? 1 : 0,
        uRays: rays, uWhite: this.scene.white, uGain: 2 ** stops, uForward: [0, 0, 1], uRight: [1, 0, 0], uUp: [0, 1, 0],
      });
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    });
    gl.disable(gl.SCISSOR_TEST);
  }

  // Measures the errors of rays and lookups on each surface, from separate rays: weights that depended on the rays that
  // they weigh would darken the picture. Two independent halves separate the noise of rays from the error of lookups, to
  // which its own standard error is added: a surface in few pixels gets little trust.
  judge(state) {
    const { gl, trial } = this, many = trial.width * trial.height;
    const read = (target, into = new Float32Array(4 * many)) => {
      gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
      gl.readPixels(0, 0, trial.width, trial.height, gl.RGBA, gl.FLOAT, into);
      return into;
    };
    const [one, other] = [0, 1].map((half) => {
      for (let k = 0; k < RAYS; k++) this.gather(trial, state, k, [0.5, 0.5], true, MOST + RAYS * half);
      return read(trial.means[RAYS % 2]);
    });
    const place = read(trial.origin), sums = [...this.surfaces, null].map(() => [0, 0, [], 0, 0]);
    for (let i = 0; i < many; i++) {
      const id = place[4 * i + 3];
      if (id < 0) continue;
      for (const total of [sums[id], sums[this.surfaces.length]]) {
        let product = 0;
        for (let j = 4 * i; j < 4 * i + 3; j++) {
          total[0] += (RAYS * 0.5 * (one[j] - other[j]) ** 2) / 3;
          product += (one[j] * other[j]) / 3;
        }
        total[1] += product;
        total[4] += product ** 2;
        total[2].push(one[4 * i + 3]);
        total[3] += 1;
      }
    }
    const all = sums.pop();
    const judged = sums.map((own) => (own[3] >= ENOUGH ? own : all)).map(([ray, lookup, usual, n, squares]) =>
      [ray, Math.max(lookup, 0) + Math.sqrt(Math.max(squares - lookup ** 2 / Math.max(n, 1), 0)), usualOf(usual)].map((x) => x / Math.max(n, 1)));
    this.trust = judged.flat();
    this.enough = Math.max(64, Math.min(MOST, Math.ceil(Math.max(...judged.map(([ray]) => ray)) / FINE ** 2)));
  }

  // What rays aim at, one after the other; lights have their weights.
  aims(state) {
    const weighed = ({ light, color }) => color.map((x) => x * (light < 0 ? 1 : state.weights[light]));
    const discs = this.scene.resting.discs.slice(0, 8);
    const mirror = { uAim: MIRROR, "uDiscs[0]": discs.flatMap((d) => [...d.axis, d.cosine]), "uDiscShine[0]": discs.flatMap(weighed) };
    if (!discs.length) Object.assign(mirror, { "uDiscs[0]": [0, 0, 0, 2], "uDiscShine[0]": [0, 0, 0] });
    for (let k = Math.max(1, discs.length); k < 8; k++) mirror["uDiscs[0]"].push(0, 0, 0, 2);
    return [
      { uAim: OPEN },
      ...(this.image?.asked ? [{ uAim: IMAGE }] : []),
      ...(this.coats(state).some((rough) => rough >= 0) ? [mirror] : []),
      ...this.scene.resting.discs.map((disc) => ({ uAim: DISC, uAxis: disc.axis, uCosine: disc.cosine, uShine: weighed(disc) })),
      ...this.scene.resting.lamps.map((lamp) => {
        const wall = this.scene.walls[lamp.wall];
        return { uAim: LAMP, uLamp0: wall.corner, uLampU: wall.edgeU, uLampV: wall.edgeV, uLampNormal: wall.normal, uShine: weighed(lamp) };
      }),
    ];
  }

  // The image of the sky at the weights of its lights.
  paint({ weights }) {
    const { gl, scene: { resting: { images, size } } } = this;
    if (!images.length) return;
    const { texels, soft, asked } = skyTexels(this.data, size, images.map(({ light, offset, exposure }) => ({ offset, share: exposure * (light < 0 ? 1 : weights[light]) })));
    if (!this.image) {
      this.image = { texture: gl.createTexture() };
      gl.bindTexture(gl.TEXTURE_2D, this.image.texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32F, ...size);
      for (const name of ["MIN_FILTER", "MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], gl.NEAREST);
    }
    Object.assign(this.image, { soft, asked });
    gl.bindTexture(gl.TEXTURE_2D, this.image.texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ...size, gl.RGBA, gl.FLOAT, texels);
  }

  // Roughness of each surface's coat; -1: no coat.
  coats({ look }) {
    return [...Array(16).keys()].map((k) => (k >= this.scene.fields.length ? -1 : (this.scene.fields[k].rough ?? (look === "shiny" ? SHINY : -1))));
  }

  sky({ weights, turn }) {
    const { scene } = this, total = Array(25).fill([0, 0, 0]);
    const add = (coefficients, share) => coefficients.forEach((c, b) => (total[b] = sum([1, total[b]], [share, c])));
    for (const { light, coefficients } of scene.resting.skies) add(coefficients, light < 0 ? 1 : weights[light]);
    if (scene.sky) add(skyTurned(scene.sky.coefficients, turn), scene.sky.exposure);
    return { "uSky[0]": total.flat(), uPictured: this.image ? 1 : 0 };
  }

  // Adds one ray from every pixel, at this position within it, to the mean of `count` rays before.
  gather(into, state, count, place, isTrial, first = 0) {
    const { gl, picture, scene, programs } = this, { width, height } = into;
    gl.viewport(0, 0, width, height);
    const seen = { ...picture.seen(state, width, height, place), uRoll: ((first + count) * 0.7548776662466927) % 1, uLook: LOOKS.indexOf(state.look), uClip: picture.clip(state) };
    const coats = { "uCoats[0]": this.coats(state), uEyeAt: seen.uEye };
    const usual = ({ usual: each }) => (scene.lights.length ? each.reduce((total, mean, k) => total + mean * state.weights[k], 0) : each[0]); // mean light
    const fields = scene.fields.map((field, k) => ({ ...picture.fieldUniforms(field, k, state), uId: k, uNear: field.light.near, uAlike: ALIKE * usual(field.light) }));
    const walls = scene.walls.map((wall, k) => ({ ...picture.wallUniforms(wall, state), uId: scene.fields.length + k, uNear: wall.near, uAlike: ALIKE * usual(wall) }));
    const draw = (made, uniforms, kind = gl.TRIANGLES, vertices = 3) => {
      gl.useProgram(made.built);
      set(gl, made, uniforms);
      gl.drawArrays(kind, 0, vertices);
    };
    const clear = (target, depth, alpha) => {
      gl.bindFramebuffer(gl.FRAMEBUFFER, target.frame);
      gl.disable(gl.BLEND);
      gl[depth ? "enable" : "disable"](gl.DEPTH_TEST);
      gl.clearColor(0, 0, 0, alpha);
      gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    };
    clear(into.origin, true, -1);
    fields.forEach((own, k) => draw(programs.origin, { ...seen, ...own, ...picture.fieldTextures(k) }));
    walls.forEach((own, k) => {
      if (dot(own.uNormal, sum([1, seen.uEye], [-1, own.uCorner])) > 0) draw(programs.originWall, { ...seen, ...own, ...picture.wallTextures() }, gl.TRIANGLE_STRIP, 4);
    });
    const number = first + count, flat = { uForward: [0, 0, 1], uRight: [1, 0, 0], uUp: [0, 1, 0], uJitter: [0, 0] };
    const turned = (steps) => steps.map((x) => (0.5 + number * x) % 1);
    const common = { ...flat, ...coats, uRoll: seen.uRoll, uLook: 0, "uSkyAxes[0]": scene.resting.axes.flat(), uSoft: this.image?.soft ?? 0, "uKept[0]": this.surfaces.flatMap((s) => s.albedo) };
    const cast = (aim, from, [places, normals], target, sum) => {
      const ray = { ...common, ...aim, ...from };
      const origins = () => ({ uPlace: picture.bind(3, gl.TEXTURE_2D, places), uNormals: picture.bind(4, gl.TEXTURE_2D, normals), uImage: picture.bind(5, gl.TEXTURE_2D, this.image?.texture ?? null) });
      clear(target, true, -1);
      gl.depthFunc(gl.LEQUAL);
      draw(programs.sky, { ...ray, ...this.sky(state), ...origins() });
      gl.depthFunc(gl.LESS);
      fields.forEach((own, k) => draw(programs.field, { ...ray, ...own, ...picture.fieldTextures(k), ...origins() }));
      walls.forEach((own) => draw(programs.wall, { ...ray, ...own, ...picture.wallTextures(), ...origins() }));
      picture.copy(target, sum.frame, () => gl.blendFunc(gl.ONE, gl.ONE));
    };
    clear(into.mirror, false, 0);
    clear(into.found, false, 0);
    const straight = { uOnward: 0, uTurn: turned(ROBERTS_2) }, onward = { uOnward: 1, uTurn: turned(ROBERTS_4) };
    for (const aim of this.aims(state)) {
      cast(aim, straight, into.origin.colors, into.ray, aim.uAim === MIRROR ? into.mirror : into.found);
      if (aim.uAim !== OPEN) continue;
      for (const next of this.aims(state)) if (next.uAim !== MIRROR) cast(next, onward, into.ray.colors.slice(1), into.onward, into.found);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, into.means[(count + 1) % 2].frame);
    gl.disable(gl.BLEND);
    const bound = (unit, texture) => picture.bind(unit, gl.TEXTURE_2D, texture);
    draw(programs.blend, {
      ...flat, ...coats, "uOpaque[0]": [...scene.fields.map((field) => 1 - field.through), 1],
      uOldCoat: bound(5, into.means[count % 2].colors[1]), uMirror: bound(6, into.mirror.color),
      uOld: bound(0, into.means[count % 2].color), uFound: bound(1, into.found.color), uKnown: bound(2, into.origin.colors[2]),
      uPlace: bound(3, into.origin.colors[0]), uNormals: bound(4, into.origin.colors[1]),
      uShare: 1 / (count + 1), uTrial: isTrial ? 1 : 0, "uTrust[0]": this.trust ?? [0], "uAlbedos[0]": this.surfaces.flatMap((s, k) => (this.tinted && k < scene.fields.length ? [1, 1, 1] : s.albedo)),
    });
  }
}
