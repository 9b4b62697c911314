// Light before it is complete: one in `every` texels along each axis is known, and light is linear between them.

import { HALVES, lightTexels } from "./numbers.js";

// Rounds numbers within the range of half floats to these; those below the least normal one become 0.
function halves(values) {
  const bits = new Uint32Array(values.buffer), result = new Uint16Array(values.length);
  for (let i = 0; i < bits.length; i++) {
    const size = bits[i] & 0x7fffffff;
    result[i] = ((bits[i] >>> 16) & 0x8000) | (size < 0x38800000 ? 0 : (size - 0x37fff000) >>> 13);
  }
  return result;
}

// Interpolates linearly from texels of a coarse lattice, of `each` half floats, to those of a fine one; constant beyond the last node.
function between(texels, each, coarse, fine, every) {
  let values = Float32Array.from(texels, (h) => HALVES[h]), inner = each;
  for (let axis = 0; axis < 3; axis++) {
    const m = coarse[axis], n = fine[axis], outer = values.length / (inner * m), result = new Float32Array(outer * n * inner);
    for (let o = 0; o < outer; o++) for (let i = 0; i < n; i++) {
      const at = Math.min(i / every, m - 1), low = Math.floor(at), share = at - low;
      const a = (o * m + low) * inner, b = (o * m + Math.min(low + 1, m - 1)) * inner, to = (o * n + i) * inner;
      for (let j = 0; j < inner; j++) result[to + j] = values[a + j] * (1 - share) + values[b + j] * share;
    }
    values = result;
    inner *= n;
  }
  return halves(values);
}

export function coarseTexels(bytes, about) {
  const shape = about.shape.map((n) => Math.max(2, Math.ceil(n / about.every)));
  return between(lightTexels(bytes, { ...about, shape }), about.channels + 1, shape, about.shape, about.every);
}
