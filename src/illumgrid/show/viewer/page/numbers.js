// From the bytes in the page to arrays for the graphics card.

const BRICK = 4; // cells along the side of a brick, as in field.frag

export async function unpack(base64) {
  if (typeof DecompressionStream === "undefined") {
    throw new Error("This browser cannot unpack the data (no DecompressionStream); any browser since 2023 can.");
  }
  const text = atob(base64);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return inflate(bytes);
}

export async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Numbers of 16 bits are stored as all low bytes, then all high bytes.
function words(bytes, count) {
  const result = new Uint16Array(count);
  for (let i = 0; i < count; i++) result[i] = bytes[i] | (bytes[count + i] << 8);
  return result;
}

// Field values: each is written as the difference to its neighbour along x.
export function fieldValues(bytes, about) {
  const [nx, ny, nz] = about.shape;
  const count = nx * ny * nz;
  const part = bytes.subarray(about.offset, about.offset + count * about.bytes);
  const values = about.bytes === 1 ? part.slice() : words(part, count);
  for (let row = 0; row < count; row += nx) {
    for (let i = row + 1; i < row + nx; i++) values[i] += values[i - 1];
  }
  return values;
}

// Half floats: one channel of light or three, then the error; green and blue are differences to red.
export function lightTexels(bytes, about) {
  const count = about.shape[0] * about.shape[1] * about.shape[2], each = about.channels + 1;
  const texels = new Uint16Array(each * count);
  for (let k = 0; k < each; k++) {
    const from = about.offset + 2 * count * k, channel = words(bytes.subarray(from, from + 2 * count), count);
    const difference = k > 0 && k < about.channels;
    for (let i = 0; i < count; i++) texels[each * i + k] = channel[i] + (difference ? texels[each * i] : 0);
  }
  return texels;
}

export const HALVES = Float32Array.from({ length: 65536 }, (_, h) => {
  const power = (h >> 10) & 31, size = power ? (1024 + (h & 1023)) * 2 ** (power - 25) : (h & 1023) * 2 ** -24;
  return h & 32768 ? -size : size;
});

// Texels for which parts of a mixture are stored: the lit ones if a mask names them, else all.
export function heldTexels(bytes, about) {
  const count = about.shape[0] * about.shape[1] * about.shape[2], held = [];
  for (let i = 0; i < count; i++) if (about.mask === undefined || (bytes[about.mask + (i >> 3)] >> (i & 7)) & 1) held.push(i);
  return held;
}

// The parts whose weighted sum is the light, as in `mix.frag`. For each, `shares` gives its weights in the channels, from
// the weights of the lights and the coefficients of the sky; `put` writes its values to every fourth place of an array.
export function lightParts(bytes, about, held) {
  const { channels, shape } = about, count = shape[0] * shape[1] * shape[2], picked = about.mask === undefined ? null : held;
  const halves = (offset, many, which) => (into, from) => {
    for (let i = 0; i < held.length; i++) {
      const at = offset + (which ? which[i] : i);
      into[4 * i + from] = HALVES[bytes[at] | (bytes[at + many] << 8)];
    }
  };
  const steps = (offset, scale) => (into, from) => {
    for (let i = 0; i < held.length; i++) into[4 * i + from] = scale * ((bytes[offset + i] << 24) >> 24);
  };
  const shares = (of) => [0, 1, 2, 3].map((k) => (k < channels ? of(k) : 0));
  const layers = (about.layers ?? []).map(({ light, color, offset }) => ({
    shares: (weights) => shares((k) => color[k] * weights[light]), put: halves(offset, count, picked),
  }));
  const answers = (about.sky ?? []).map(({ color, basis, offset, scale }) => ({
    shares: (_, sky) => shares((k) => (color >= 0 && color !== k ? 0 : basis ? basis.reduce((s, f, b) => s + f * sky[b][k], 0) : 1)),
    put: scale ? steps(offset, scale) : halves(offset, held.length, null),
  }));
  return [...layers, ...answers];
}

// Exposed light of the six faces of a field's box, 18 numbers, for these weights of the lights or coefficients of the sky.
export function capLight({ shown, layers, sky, rest }, weights, turned) {
  const mixed = (face, k) => {
    if (layers.length) return layers.reduce((sum, layer, j) => sum + weights[j] * layer[face][k], 0);
    return turned && sky ? sky[face].reduce((sum, f, b) => sum + f * turned[b][k], rest[face][k]) : shown[face][k];
  };
  return shown.flatMap((color, face) => color.map((known, k) => (known < 0 ? -1 : Math.max(0, mixed(face, k)))));
}

// Images of the sky at the weights of their lights, as texels: radiance, and the sum up to each texel of the excess above
// `soft`, which rays aim at. `soft` is BRIGHT times the mean colour of the sky.
const BRIGHT = 4;
export function skyTexels(bytes, [width, height], images) {
  const texels = new Float32Array(4 * width * height), cosines = Float64Array.from({ length: height }, (_, j) => Math.cos(Math.PI * (0.5 - (j + 0.5) / height)));
  for (const { offset, share } of images) {
    const light = words(bytes.subarray(offset, offset + 6 * width * height), 3 * width * height);
    for (let i = 0; i < width * height; i++) for (let k = 0; k < 3; k++) texels[4 * i + k] += share * HALVES[light[3 * i + k]];
  }
  const each = (i) => [(texels[4 * i] + texels[4 * i + 1] + texels[4 * i + 2]) / 3, cosines[Math.floor(i / width)]];
  let total = 0, weight = 0, sum = 0;
  for (let i = 0; i < width * height; i++) {
    const [mean, cosine] = each(i);
    total += mean * cosine;
    weight += cosine;
  }
  const soft = (BRIGHT * total) / weight;
  for (let i = 0; i < width * height; i++) {
    const [mean, cosine] = each(i);
    texels[4 * i + 3] = sum += Math.max(mean - soft, 0) * cosine;
  }
  return { texels, soft, asked: sum > 1e-3 * total };
}

// Least and largest value over the 5³ voxels of each brick: rays jump over bricks that no level set crosses.
export function bricks(values, [nx, ny, nz]) {
  const shape = [nx, ny, nz].map((n) => Math.ceil((n - 1) / BRICK));
  const result = new Uint16Array(2 * shape[0] * shape[1] * shape[2]);
  let at = 0;
  for (let z = 0; z < shape[2]; z++) {
    for (let y = 0; y < shape[1]; y++) {
      for (let x = 0; x < shape[0]; x++, at += 2) {
        let low = 65535, high = 0;
        for (let k = z * BRICK; k <= Math.min(z * BRICK + BRICK, nz - 1); k++) {
          for (let j = y * BRICK; j <= Math.min(y * BRICK + BRICK, ny - 1); j++) {
            const row = nx * (j + ny * k);
            for (let i = row + x * BRICK; i <= row + Math.min(x * BRICK + BRICK, nx - 1); i++) {
              if (values[i] < low) low = values[i];
              if (values[i] > high) high = values[i];
            }
          }
        }
        result[at] = low;
        result[at + 1] = high;
      }
    }
  }
  return { shape, values: result };
}
