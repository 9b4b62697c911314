// One field: where the ray meets the level set of the trilinear interpolant, as in the pictures and the light paths.
const int BRICK = 4;                 // cells along the side of a brick, as in numbers.js
const int NOTHING = 0, SURFACE = 1, CAP = 2;

uniform usampler3D uField;           // voxel values in steps, turned so that the solid is upwards
uniform usampler3D uBricks;          // least and largest value of each brick
uniform sampler3D uLight;            // exposed light, then its relative error: -1 in a hole
uniform mat4 uToIndex, uToTexture;   // from the stage to voxel indices, and to texture coordinates of the light
uniform float uLevel;                // isovalue in steps
uniform vec3 uAlbedo;
uniform bool uBothSides;             // a translucent surface is seen from its back too
uniform float uThrough, uRoll;       // share of what lies behind that is seen; a number that is another for each ray
uniform vec4 uClip;                  // of rays from the eye: what has a larger product with .xyz than .w is not there
float chance(float k) { return fract(52.9829189 * fract(dot(gl_FragCoord.xy + 17.3 * k, vec2(0.06711056, 0.00583715))) + uRoll + 0.618034 * k); }

// How much of a surface is there that faces a ray by this cosine.
float opaque(float facing) { return uLook == TRANSLUCENT ? 1.0 - pow(0.62, 1.0 / max(facing, 0.12)) : 1.0 - uThrough; }
float value(ivec3 voxel) { return float(texelFetch(uField, voxel, 0).r); }
float least(vec3 v) { return min(v.x, min(v.y, v.z)); }
float most(vec3 v) { return max(v.x, max(v.y, v.z)); }

// Differences to the level at the corners of a cell: x runs fastest.
void corners(ivec3 cell, out vec4 near, out vec4 far) {
  near = vec4(value(cell), value(cell + ivec3(1, 0, 0)), value(cell + ivec3(0, 1, 0)), value(cell + ivec3(1, 1, 0))) - uLevel;
  far = vec4(value(cell + ivec3(0, 0, 1)), value(cell + ivec3(1, 0, 1)), value(cell + ivec3(0, 1, 1)), value(cell + ivec3(1, 1, 1))) - uLevel;
}

float trilinear(vec4 near, vec4 far, vec3 f) {
  vec4 c = mix(near, far, f.z);
  vec2 d = mix(c.xy, c.zw, f.y);
  return mix(d.x, d.y, f.x);
}

// Coefficients of the cubic that the trilinear function is along e + s d.
vec4 cubic(vec4 n, vec4 f, vec3 e, vec3 d) {
  float kx = n.y - n.x, ky = n.z - n.x, kz = f.x - n.x;
  float kxy = n.w - n.z - kx, kxz = f.y - f.x - kx, kyz = f.z - f.x - ky;
  float k = (f.w - f.z - f.y + f.x) - kxy;
  vec3 pair = vec3(d.y * d.z, d.x * d.z, d.x * d.y);
  return vec4(
    trilinear(n, f, e),
    kx * d.x + ky * d.y + kz * d.z + kxy * (e.x * d.y + e.y * d.x) + kyz * (e.y * d.z + e.z * d.y)
      + kxz * (e.x * d.z + e.z * d.x) + k * (e.x * e.y * d.z + e.x * e.z * d.y + e.y * e.z * d.x),
    kxy * pair.z + kyz * pair.x + kxz * pair.y + k * dot(e, pair),
    k * d.x * pair.x);
}

float at(vec4 q, float s) { return ((q.w * s + q.z) * s + q.y) * s + q.x; }

bool crosses(float before, float after) {
  return (before < 0.0 && after >= 0.0) || (uBothSides && before >= 0.0 && after < 0.0);
}

// First crossing in [0, 1], 2 if there is none: between its stationary points the cubic is monotone.
float firstCrossing(vec4 q, float before) {
  if (crosses(before, q.x)) return 0.0;          // rounding at the face between two cells opens no hole
  float a = 3.0 * q.w, b = q.z, turn = b * b - a * q.y;
  vec2 stop = vec2(0.0);
  if (turn > 0.0) {                              // a s² + 2 b s + q.y = 0, without cancellation
    float w = -(b + (b < 0.0 ? -1.0 : 1.0) * sqrt(turn));
    stop = clamp(vec2(a == 0.0 ? 0.0 : w / a, w == 0.0 ? 0.0 : q.y / w), 0.0, 1.0);
    if (stop.x > stop.y) stop = stop.yx;
  }
  float low = 0.0, atLow = q.x;
  for (int k = 0; k < 3; k++) {
    float high = k == 0 ? stop.x : k == 1 ? stop.y : 1.0, atHigh = at(q, high);
    if (high > low && crosses(atLow, atHigh)) {
      float s = mix(low, high, atLow / (atLow - atHigh));
      bool rising = atLow < 0.0;
      for (int i = 0; i < 8; i++) {          // Newton steps, kept between the ends by bisection
        float here = at(q, s), slope = (3.0 * q.w * s + 2.0 * q.z) * s + q.y;
        if ((here < 0.0) == rising) low = s; else high = s;
        float next = slope == 0.0 ? s : s - here / slope;
        s = next > low && next < high ? next : 0.5 * (low + high);
      }
      return s;
    }
    low = high;
    atLow = atHigh;
  }
  return 2.0;
}

// Distance to what the ray start + t step meets beyond `from`; `what` says what it is.
float march(vec3 start, vec3 step_, float from, out int what) {
  ivec3 size = textureSize(uField, 0);
  vec3 top = vec3(size - 1), d = mix(step_, vec3(1e-9), lessThan(abs(step_), vec3(1e-9))), inverse = 1.0 / d;
  vec3 one = -start * inverse, other = (top - start) * inverse, enter = min(one, other);
  float t = max(most(enter), from), end = least(max(one, other));
  what = NOTHING;
  if (!(t < end)) return 0.0;
  vec3 ahead = step(0.0, d);
  ivec3 cell = clamp(ivec3(floor(start + t * d)), ivec3(0), size - 2);
  vec4 near, far;
  corners(cell, near, far);
  float before = trilinear(near, far, clamp(start + t * d - vec3(cell), 0.0, 1.0));
  if (most(enter) >= from && before >= 0.0) {    // the border of the volume cuts the solid
    what = CAP;
    return t;
  }
  float hit = 0.0;
  for (int guard = 0; guard < 8192; guard++) {
    ivec3 brick = cell / BRICK;
    uvec2 held = texelFetch(uBricks, brick, 0).rg;
    bool empty = float(held.y) < uLevel, whole = empty || float(held.x) >= uLevel;
    ivec3 edge = whole ? brick * BRICK : cell, reach = ivec3(whole ? BRICK : 1);
    vec3 leave = (vec3(edge) + ahead * vec3(reach) - start) * inverse;
    float until = min(max(least(leave), t), end);
    if (whole) {
      bool crossed = crosses(before, empty ? -1.0 : 1.0);
      before = empty ? -1.0 : 1.0;
      if (crossed) { hit = t; what = SURFACE; break; }
    } else {
      corners(cell, near, far);
      vec4 low = min(near, far), high = max(near, far);
      float lowest = min(min(low.x, low.y), min(low.z, low.w)), highest = max(max(high.x, high.y), max(high.z, high.w));
      if (lowest < 0.0 && highest >= 0.0) {
        vec4 q = cubic(near, far, clamp(start + t * d - vec3(cell), 0.0, 1.0), d * (until - t));
        float s = firstCrossing(q, before);
        if (s <= 1.0) { hit = mix(t, until, s); what = SURFACE; break; }
        before = at(q, 1.0);
      } else {
        bool crossed = crosses(before, lowest < 0.0 ? -1.0 : 1.0);
        before = lowest < 0.0 ? -1.0 : 1.0;
        if (crossed) { hit = t; what = SURFACE; break; }
      }
    }
    if (until >= end) break;
    t = until;
    ivec3 axis = leave.x <= leave.y && leave.x <= leave.z ? ivec3(1, 0, 0) : leave.y <= leave.z ? ivec3(0, 1, 0) : ivec3(0, 0, 1);
    ivec3 beyond = edge + ivec3(ahead) * (reach + 1) - 1, within = clamp(ivec3(floor(start + t * d)), edge, min(edge + reach - 1, size - 2));
    cell = within + axis * (beyond - within);
    if (any(lessThan(cell, ivec3(0))) || any(greaterThan(cell, size - 2))) break;
  }
  return hit;
}

// Central differences at the voxels, one-sided at the border, interpolated; where they cancel, those of the cell.
vec3 gradient(vec3 index) {
  ivec3 last = textureSize(uField, 0) - 1, cell = clamp(ivec3(floor(index)), ivec3(0), last - 1);
  vec3 f = clamp(index - vec3(cell), 0.0, 1.0), sum = vec3(0.0);
  for (int k = 0; k < 8; k++) {
    ivec3 corner = ivec3(k & 1, (k >> 1) & 1, k >> 2), v = cell + corner, up = min(v + 1, last), down = max(v - 1, 0);
    vec3 w = mix(1.0 - f, f, vec3(corner));
    vec3 rise = vec3(value(ivec3(up.x, v.yz)) - value(ivec3(down.x, v.yz)),
                         value(ivec3(v.x, up.y, v.z)) - value(ivec3(v.x, down.y, v.z)),
                         value(ivec3(v.xy, up.z)) - value(ivec3(v.xy, down.z)));
    sum += w.x * w.y * w.z * rise / vec3(up - down);
  }
  if (sum != vec3(0.0)) return sum;
  vec4 n, r;
  corners(cell, n, r);
  vec4 z = mix(n, r, f.z);
  vec2 y = mix(z.xy, z.zw, f.y);
  return vec3(y.y - y.x, mix(z.z - z.x, z.w - z.y, f.x), mix(mix(r.x - n.x, r.y - n.y, f.x), mix(r.z - n.z, r.w - n.w, f.x), f.y));
}

// What a ray from the eye meets within the clip plane, beyond `from`.
const int CUT = 3;
float march_clipped(vec3 eye, vec3 ray, float from, out int what) {
  float along = dot(uClip.xyz, ray), room = uClip.w - dot(uClip.xyz, eye), enter = along < 0.0 ? room / along : 0.0;
  vec3 start = (uToIndex * vec4(eye, 1.0)).xyz, ahead = mat3(uToIndex) * ray;
  what = NOTHING;
  if (along >= 0.0 && room < 0.0) return 0.0;
  if (enter > max(from, 0.0)) {
    from = enter;
    vec3 at = start + enter * ahead, top = vec3(textureSize(uField, 0) - 1);
    if (uThrough == 0.0 && uLook != TRANSLUCENT && at == clamp(at, vec3(0.0), top)) {
      ivec3 cell = min(ivec3(at), ivec3(top) - 1);
      vec4 near, far;
      corners(cell, near, far);
      if (trilinear(near, far, at - vec3(cell)) >= 0.0) { what = CUT; return enter; }
    }
  }
  float t = march(start, ahead, from, what);
  if (along > 0.0 && t > room / along) what = NOTHING;
  return t;
}
