// What a pixel shows of one field.
uniform vec3 uEye;
uniform sampler2D uFront;            // depth of the layer in front, when layers are peeled
uniform bool uPeel;
uniform float uRough;                // of the surface's own coat, below 0 without; only rays at rest know how rough
uniform vec2 uWindow;                // values in steps that a cut shows black and white
uniform bool uTint;                  // colours of a second quantity
uniform bool uBase;                  // which alone are drawn
uniform sampler3D uSecond;
uniform sampler2D uMap;
uniform mat4 uToSecond;
uniform vec3 uCaps[6];               // exposed light of the faces of the box: of each axis the first, then the last; below 0 if not known

in vec3 vRay;

// Relative error of the lookup at a place; -1 where it mixes a node without light of its own.
float doubt(vec3 place) {
  ivec3 size = textureSize(uLight, 0);
  vec3 node = clamp(place * vec3(size) - 0.5, vec3(0.0), vec3(size - 1));
  ivec3 cell = min(ivec3(floor(node)), size - 2);
  vec3 f = node - vec3(cell);
  float error = 0.0;
  for (int k = 0; k < 8; k++) {
    ivec3 corner = ivec3(k & 1, (k >> 1) & 1, k >> 2);
    vec3 w = mix(1.0 - f, f, vec3(corner));
    float e = errorOf(texelFetch(uLight, cell + corner, 0)), share = w.x * w.y * w.z;
    if (share > 0.0 && e < 0.0) return -1.0;
    error += share * e;
  }
  return error;
}

// The face of the box next to a place.
int faceAt(vec3 index) {
  vec3 low = abs(index), high = abs(index - vec3(textureSize(uField, 0) - 1)), near = min(low, high);
  int axis = near.x <= near.y && near.x <= near.z ? 0 : near.y <= near.z ? 1 : 2;
  return 2 * axis + (high[axis] < low[axis] ? 1 : 0);
}

void main() {
  vec3 ray = normalize(vRay);
  float from = 0.0;
  if (uPeel) {
    float depth = texelFetch(uFront, ivec2(gl_FragCoord.xy), 0).r;
    from = depth < 1.0 ? distanceOf(depth) + 0.004 / length(mat3(uToIndex) * ray) : 1e9;
  }
  int what;
  float t = march_clipped(uEye, ray, from, what);
  if (what == NOTHING) discard;
  gl_FragDepth = depthOf(t);
  vec3 place = uEye + t * ray;
  if (uBase && what != SURFACE) { color_ = vec4(0.0); return; }
  if (what == CUT) {                 // the data, as values of sRGB
    vec3 at = (uToIndex * vec4(place, 1.0)).xyz;
    ivec3 cell = clamp(ivec3(at), ivec3(0), textureSize(uField, 0) - 2);
    vec4 near, far;
    corners(cell, near, far);
    float grey = clamp((trilinear(near, far, at - vec3(cell)) + uLevel - uWindow.x) / (uWindow.y - uWindow.x), 0.0, 1.0);
    draw(vec3(grey <= 0.04045 ? grey / 12.92 : pow((grey + 0.055) / 1.055, 2.4)), 1.0);
    return;
  }
  vec3 texel = (uToTexture * vec4(place, 1.0)).xyz;
  bool local = isLocal(), cap = what == CAP;
  vec3 normal = vec3(0.0), color, light;
  if (cap) {
    int face = faceAt((uToIndex * vec4(place, 1.0)).xyz);
    light = uCaps[face];
    if (isTrust() || (light.r < 0.0 && !local)) { draw(uCapTone * (isTrust() ? vec3(0.5) : uAlbedo), 1.0); return; }
    normal = (face % 2 == 0 ? -1.0 : 1.0) * normalize(transpose(mat3(uToIndex))[face / 2]);
  } else if (local || uLook != MATTE || uRough >= 0.0 || isTrust()) {
    normal = -normalize(transpose(mat3(uToIndex)) * gradient((uToIndex * vec4(place, 1.0)).xyz));
  }
  float facing = abs(dot(normal, ray));
  if (isTrust()) { draw(trusted(doubt(texel)) * (0.4 + 0.6 * facing), 1.0); return; }
  if (!cap) light = lightOf(texture(uLight, texel));
  if (local) color = uGain * uWhite * uAlbedo / max(most(uAlbedo), 1e-9) * max(-dot(normal, ray), uBothSides ? facing : 0.0);
  else color = uGain * uAlbedo * light;
  if (uTint) {
    vec3 base = texture(uMap, vec2(texture(uSecond, (uToSecond * vec4(place, 1.0)).xyz).r * 255.0 / 256.0 + 0.5 / 256.0, 0.5)).rgb;
    if (uBase) color = base;
    else if (uRaw) color = uGain * light;
    else color = base * (local ? facing * uGain * uWhite : dot(curve(uGain * light), vec3(0.2126, 0.7152, 0.0722)));
  }
  if (!uRaw && !cap && (uLook == SHINY || uRough >= 0.0)) color = 0.8 * color + gloss(normal, ray, local ? vec3(uWhite) : light);
  float there = cap ? 1.0 : opaque(facing);
  if (uLook != TRANSLUCENT) color *= there;   // the tone curve sees what the surface adds, as in the pictures
  draw(uTint ? color : curve(color), 1.0);
  color_.a = there;
  if (uLook == TRANSLUCENT) color_.rgb *= there;
}
