// Mixes light on the graphics card, from layers or responses to a sky: once per change, not in every pixel.

import { heldTexels, lightParts } from "./numbers.js";
import { set } from "./programs.js";

const WIDE = 2048; // texels of a texture that holds parts; any graphics card takes as many
const AT_ONCE = 4; // such textures in one pass, of four parts each

export class Mixture {
  constructor(picture, about, into) {
    const { gl, data } = picture, held = heldTexels(data, about), high = Math.max(1, Math.ceil(held.length / WIDE));
    Object.assign(this, { picture, about, into, parts: lightParts(data, about, held), frame: gl.createFramebuffer() });
    this.textures = [];
    for (let k = 0; k < this.parts.length; k += 4) {
      const values = new Float32Array(4 * WIDE * high);
      this.parts.slice(k, k + 4).forEach(({ put }, j) => put(values, j));
      const texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA16F, WIDE, high);
      gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, WIDE, high, gl.RGBA, gl.FLOAT, values);
      for (const name of ["MIN_FILTER", "MAG_FILTER"]) gl.texParameteri(gl.TEXTURE_2D, gl[`TEXTURE_${name}`], gl.NEAREST);
      this.textures.push(texture);
    }
    if (about.mask === undefined) return;
    const places = new Uint32Array(about.shape[0] * about.shape[1] * about.shape[2]); // from 1; 0 is dark
    held.forEach((i, place) => (places[i] = place + 1));
    this.places = picture.volume(gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, about.shape, places, gl.NEAREST);
  }

  // Draws into the texture of light, slice by slice.
  draw(weights, sky) {
    const { picture, about, textures } = this, { gl, mixProgram } = picture, [nx, ny, nz] = about.shape;
    const shares = this.parts.flatMap((part) => part.shares(weights, sky));
    gl.useProgram(mixProgram.built);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.viewport(0, 0, nx, ny);
    gl.disable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    gl.colorMask(true, about.channels > 1, true, false); // keeps the error
    set(gl, mixProgram, {
      uPlaces: picture.bind(AT_ONCE, gl.TEXTURE_3D, this.places ?? null), uSome: this.places ? 1 : 0, uShape: [nx, ny],
      uForward: [0, 0, 1], uRight: [1, 0, 0], uUp: [0, 1, 0],
    });
    for (let first = 0; first < textures.length; first += AT_ONCE) {
      const units = Array.from({ length: AT_ONCE }, (_, k) => picture.bind(k, gl.TEXTURE_2D, textures[first + k] ?? textures[first]));
      const values = Float32Array.from({ length: 16 * AT_ONCE }, (_, k) => shares[16 * first + k] ?? 0);
      set(gl, mixProgram, { "uParts[0]": units, "uShares[0]": values });
      if (first) gl.enable(gl.BLEND);
      for (let z = 0; z < nz; z++) {
        gl.framebufferTextureLayer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, this.into, 0, z);
        set(gl, mixProgram, { uSlice: z });
        gl.drawArrays(gl.TRIANGLES, 0, 3);
      }
    }
    gl.colorMask(true, true, true, true);
    picture.bind(AT_ONCE, gl.TEXTURE_3D, null); // integers, which no other program reads there
  }
}
