// Draws one picture: layers of fields and walls, averaged over positions within the pixel.

import { coarseTexels } from "./coarse.js";
import { bricks, capLight, fieldValues, lightTexels } from "./numbers.js";
import { dot, eyeOf, facing, sum } from "./camera.js";
import { Mixture } from "./mixture.js";
import { program, set } from "./programs.js";
import { skyTurned } from "./skies.js";
import { DEFAULTS, isovalueOf } from "./state.js";

export const LOOKS = ["matte", "shiny", "translucent"];
const LAYERS = 4; // surfaces behind one another that a translucent look shows

export class Picture {
  constructor(canvas, scene, data, shaders) {
    this.canvas = canvas;
    this.scene = scene;
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false, powerPreference: "high-performance" });
    if (!gl) throw new Error("This page draws with WebGL2, which this browser or its graphics driver does not offer.");
    this.gl = gl;
    this.single = gl.getExtension("EXT_color_buffer_float");
    if (!this.single && !gl.getExtension("EXT_color_buffer_half_float")) {
      throw new Error("This page draws into floating-point textures, which this graphics driver does not support.");
    }
    const largest = gl.getParameter(gl.MAX_3D_TEXTURE_SIZE);
    const sides = scene.fields.flatMap((f) => [...f.values.shape, ...f.light.shape]).concat(scene.atlas?.shape ?? []);
    if (Math.max(...sides) > largest) {
      throw new Error(`The volume has ${Math.max(...sides)} voxels along one side; this graphics driver takes at most ${largest}.`);
    }
    this.vertices = gl.createVertexArray();
    gl.bindVertexArray(this.vertices);
    this.fieldProgram = program(gl, shaders["ray.vert"], shaders["shared.glsl"] + shaders["march.glsl"] + shaders["field.frag"]);
    this.wallProgram = program(gl, shaders["wall.vert"], shaders["shared.glsl"] + shaders["wall.frag"]);
    this.copyProgram = program(gl, shaders["ray.vert"], shaders["copy.frag"]);
    this.mixProgram = program(gl, shaders["ray.vert"], shaders["mix.frag"]);
    this.fields = scene.fields.map((field) => {
      const values = fieldValues(data, field.values);
      const held = bricks(values, field.values.shape);
      return {
        values: field.values.bytes === 1
          ? this.volume(gl.R8UI, gl.RED_INTEGER, gl.UNSIGNED_BYTE, field.values.shape, values, gl.NEAREST)
          : this.volume(gl.R16UI, gl.RED_INTEGER, gl.UNSIGNED_SHORT, field.values.shape, values, gl.NEAREST),
        bricks: this.volume(gl.RG16UI, gl.RG_INTEGER, gl.UNSIGNED_SHORT, held.shape, held.values, gl.NEAREST),
        light: this.light(field.light, data),
      };
    });
    this.walls = scene.atlas ? this.light(scene.atlas, data) : null;
    if (scene.tint) {
      gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
      const map = gl.getParameter(gl.TEXTURE_BINDING_2D), colors = Uint8Array.from({ length: 1024 }, (_, k) => (k % 4 === 3 ? 255 : data[scene.tint.map + 3 * (k >> 2) + (k % 4)]));
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.SRGB8_ALPHA8, 256, 1);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 256, 1, gl.RGBA, gl.UNSIGNED_BYTE, colors);
      for (const name of ["MIN_FILTER", "MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], gl.NEAREST);
      this.tint = { map, values: this.volume(gl.R8, gl.RED, gl.UNSIGNED_BYTE, scene.tint.values.shape, fieldValues(data, scene.tint.values), gl.LINEAR) };
    }
    this.size = [0, 0];
    if (scene.lights.length || scene.sky) Object.assign(this, { data, mixed: String([scene.lights.map((light) => light.weight), DEFAULTS.turn]) });
  }

  volume(format, layout, type, [nx, ny, nz], values, filter) {
    const gl = this.gl, texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_3D, texture);
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    gl.texStorage3D(gl.TEXTURE_3D, 1, format, nx, ny, nz);
    gl.texSubImage3D(gl.TEXTURE_3D, 0, 0, 0, 0, nx, ny, nz, layout, type, values);
    for (const name of ["MIN_FILTER", "MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_3D, gl[`TEXTURE_${name}`], filter);
    for (const name of ["WRAP_S", "WRAP_T", "WRAP_R"]) gl.texParameteri(gl.TEXTURE_3D, gl[`TEXTURE_${name}`], gl.CLAMP_TO_EDGE);
    return texture;
  }

  light(about, data) {
    const gl = this.gl, [format, layout] = about.channels === 1 ? [gl.RG16F, gl.RG] : [gl.RGBA16F, gl.RGBA];
    return this.volume(format, layout, gl.HALF_FLOAT, about.shape, about.every ? coarseTexels(data, about) : lightTexels(data, about), gl.LINEAR);
  }

  // Mixes the light of fields and walls for other weights or a turned sky; until these change, it is the stored light.
  mix({ weights, turn }) {
    if (!this.data || this.mixed === String([weights, turn])) return;
    this.mixed = String([weights, turn]);
    this.turned = this.scene.sky && skyTurned(this.scene.sky.coefficients, turn);
    this.mixtures ??= this.scene.fields.map((field, k) => new Mixture(this, field.light, this.fields[k].light))
      .concat(this.walls ? [new Mixture(this, this.scene.atlas, this.walls)] : []);
    for (const mixture of this.mixtures) mixture.draw(weights, this.turned);
  }

  // A render target: colours of these formats, by default half floats, and a depth that can be read back.
  target(width, height, withDepth, formats = [this.gl.RGBA16F]) {
    const gl = this.gl, made = { frame: gl.createFramebuffer() };
    gl.bindFramebuffer(gl.FRAMEBUFFER, made.frame);
    const attach = (format, filter, where) => {
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, format, width, height);
      for (const name of ["MIN_FILTER", "MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], filter);
      for (const name of ["WRAP_S", "WRAP_T"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], gl.CLAMP_TO_EDGE);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, where, gl.TEXTURE_2D, texture, 0);
      return texture;
    };
    made.colors = formats.map((format, k) => attach(format, format === gl.RGBA16F ? gl.LINEAR : gl.NEAREST, gl.COLOR_ATTACHMENT0 + k));
    made.color = made.colors[0];
    gl.drawBuffers(formats.map((_, k) => gl.COLOR_ATTACHMENT0 + k));
    if (withDepth) made.depth = attach(gl.DEPTH_COMPONENT32F, gl.NEAREST, gl.DEPTH_ATTACHMENT);
    return made;
  }

  drop(old) {
    this.gl.deleteFramebuffer(old.frame);
    for (const texture of old.colors) this.gl.deleteTexture(texture);
    if (old.depth) this.gl.deleteTexture(old.depth);
  }

  resize(width, height) {
    if (this.size[0] === width && this.size[1] === height) return;
    for (const old of [...(this.layers ?? []), this.sum, this.mean]) if (old) this.drop(old);
    this.size = [width, height];
    this.layers = [this.target(width, height, true), this.target(width, height, true)];
    this.sum = this.target(width, height, false);
    this.mean = this.target(width, height, false);
  }

  bind(unit, kind, texture) {
    this.gl.activeTexture(this.gl.TEXTURE0 + unit);
    this.gl.bindTexture(kind, texture);
    return unit;
  }

  // All fields and walls nearest to the eye, or nearest behind the layer in front.
  layer(into, front, seen, state) {
    const gl = this.gl, { scene } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, into.frame);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    const translucent = this.through(state);
    const empty = translucent || seen.uBase ? [0, 0, 0, 0] : [scene.background, scene.background, scene.background, 1];
    gl.clearColor(...empty);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const common = {
      ...seen,
      uWhite: scene.white,
      uGain: 2 ** state.stops,
      uLocalUpTo: state.light === "local" ? 1e9 : state.light === "both" ? state.split * this.size[0] : -1,
      uLook: LOOKS.indexOf(state.look),
      uCapTone: scene.capTone,
      uTrust: state.trust ? scene.trust.ends : [0, 0],
      "uScale[0]": scene.trust.scale.flat(),
      "uHatch[0]": scene.trust.hatch.flat(),
      uPeel: front ? 1 : 0,
      uFront: this.bind(3, gl.TEXTURE_2D, front ? front.depth : null),
      uClip: this.clip(state),
      uTint: this.tint && state.tint ? 1 : 0,
      ...(this.tint ? { uSecond: this.bind(4, gl.TEXTURE_3D, this.tint.values), uMap: this.bind(5, gl.TEXTURE_2D, this.tint.map), uToSecond: scene.tint.toTexture } : { uSecond: 4, uMap: 5 }),
    };
    gl.useProgram(this.fieldProgram.built);
    set(gl, this.fieldProgram, common);
    scene.fields.forEach((field, k) => {
      set(gl, this.fieldProgram, { ...this.fieldTextures(k), ...this.fieldUniforms(field, k, state), "uCaps[0]": capLight(field.caps, state.weights, this.turned), uRough: field.rough ?? -1, uWindow: field.window });
      gl.drawArrays(gl.TRIANGLES, 0, 3);
    });
    gl.useProgram(this.wallProgram.built);
    set(gl, this.wallProgram, { ...common, uLook: 0 });
    for (const wall of scene.walls) {
      if (dot(wall.normal, sum([1, seen.uEye], [-1, wall.corner])) <= 0) continue; // walls are drawn from their front only
      set(gl, this.wallProgram, { ...this.wallTextures(), ...this.wallUniforms(wall, state) });
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
  }

  fieldTextures(k) {
    const { values, bricks: held, light } = this.fields[k], gl = this.gl;
    return { uField: this.bind(0, gl.TEXTURE_3D, values), uBricks: this.bind(1, gl.TEXTURE_3D, held), uLight: this.bind(2, gl.TEXTURE_3D, light) };
  }

  fieldUniforms(field, k, { sweep, look, trust }) {
    const films = !trust;
    return {
      uThrough: films ? field.through : 0,
      uBothSides: films && (look === "translucent" || field.through > 0) ? 1 : 0,
      uToIndex: field.toIndex,
      uToTexture: field.toTexture,
      uLevel: (this.level(field, sweep) - field.values.base) / field.values.step,
      uAlbedo: field.albedo,
      uGrey: field.light.channels === 1 ? 1 : 0,
    };
  }

  wallTextures() {
    return { uWalls: this.bind(0, this.gl.TEXTURE_3D, this.walls) };
  }

  wallUniforms(wall, { sweep }) {
    const { atlas } = this.scene;
    return {
      uCorner: wall.corner, uEdgeU: wall.edgeU, uEdgeV: wall.edgeV, uNormal: wall.normal,
      uTexels: wall.texels, uOffset: wall.offset,
      uRow: (sweep * (atlas.shape[2] - 1) + 0.5) / atlas.shape[2],
      uAlbedo: wall.albedo, uEmission: wall.emission, uLocalColor: wall.localColor, uGround: wall.fades ? this.scene.background : -1,
      uGrey: atlas.channels === 1 ? 1 : 0,
    };
  }

  // Whether any surface is translucent.
  through({ look, trust }) {
    return !trust && (look === "translucent" || this.scene.fields.some((field) => field.through > 0));
  }

  // The clip plane in stage coordinates, at a place from 0 to 1: `axis` 0 to 2 cuts beyond x, y, z, and 3 to 5 before.
  clip({ clip: [axis, at] }) {
    if (axis < 0) return [0, 0, 0, 1];
    const { low, high } = this.scene.clip, k = axis % 3, sign = axis < 3 ? 1 : -1;
    return [0, 1, 2].map((j) => (j === k ? sign : 0)).concat(sign * ((1 - at) * low[k] + at * high[k]));
  }

  // Isovalue of a field at this position of the sweep; its sign is such that the solid has larger values.
  level(field, sweep) {
    return field.upward * isovalueOf(field, sweep);
  }

  copy(from, into, blend, encode = false) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, into);
    gl.disable(gl.DEPTH_TEST);
    if (blend) {
      gl.enable(gl.BLEND);
      blend();
    } else gl.disable(gl.BLEND);
    gl.useProgram(this.copyProgram.built);
    set(gl, this.copyProgram, { uPicture: this.bind(0, gl.TEXTURE_2D, from.color), uEncode: encode ? 1 : 0, uForward: [0, 0, 1], uRight: [1, 0, 0], uUp: [0, 1, 0] });
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  // The camera, for a position (0 to 1) within the pixel.
  seen({ view }, width, height, place) {
    const { scene } = this, { right, up, forward } = facing(view, scene.axes);
    const tall = scene.tangent, wide = (tall * width) / height;
    return {
      uEye: eyeOf(view, scene.axes),
      uRight: sum([wide, right]), uUp: sum([tall, up]), uForward: forward,
      uJitter: [(2 * place[0] - 1) / width, (2 * place[1] - 1) / height],
      uLamp: sum([-0.72, forward], [0.38, right], [0.58, up]),
    };
  }

  // Adds one sample, at a position within the pixel, to the mean of `count` before it. If `raw` is given, it gets the light
  // before the tone curve, or with `base` the colours of a second quantity alone.
  sample(state, width, height, place, count, raw = null, base = false) {
    const gl = this.gl, { scene } = this;
    this.resize(width, height);
    gl.viewport(0, 0, width, height);
    const seen = { ...this.seen(state, width, height, place), uRaw: raw ? 1 : 0, uBase: base ? 1 : 0 };
    let drawn = this.layers[0];
    this.layer(drawn, null, seen, state);
    if (this.through(state)) {
      const under = () => gl.blendFunc(gl.ONE_MINUS_DST_ALPHA, gl.ONE);
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.sum.frame);
      gl.clearColor(0, 0, 0, 0);
      gl.clear(gl.COLOR_BUFFER_BIT);
      this.copy(drawn, this.sum.frame, under);
      for (let k = 1; k < LAYERS; k++) {
        this.layer(this.layers[k % 2], this.layers[(k + 1) % 2], seen, state);
        this.copy(this.layers[k % 2], this.sum.frame, under);
      }
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.layers[0].frame);
      if (base) gl.clearColor(0, 0, 0, 0);
      else gl.clearColor(scene.background, scene.background, scene.background, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      this.copy(this.layers[0], this.sum.frame, under);
      drawn = this.sum;
    }
    const share = 1 / (count + 1);
    this.copy(drawn, (raw ?? this.mean).frame, count === 0 ? null : () => {
      gl.blendColor(share, share, share, share);
      gl.blendFunc(gl.CONSTANT_COLOR, gl.ONE_MINUS_CONSTANT_COLOR);
    });
  }

  show() {
    const gl = this.gl;
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    this.copy(this.mean, null, null, true);
  }

  // Waits for the graphics card, so that the time of a frame can be measured.
  wait() {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.mean.frame);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.FLOAT, new Float32Array(4));
  }
}
