// What a pixel shows of one field.
uniform vec3 uEye;
uniform sampler2D uFront;            // depth of the layer in front, when layers are peeled
uniform bool uPeel;

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

void main() {
  vec3 ray = normalize(vRay);
  float from = 0.0;
  if (uPeel) {
    float depth = texelFetch(uFront, ivec2(gl_FragCoord.xy), 0).r;
    from = depth < 1.0 ? distanceOf(depth) + 0.004 / length(mat3(uToIndex) * ray) : 1e9;
  }
  int what;
  float t = march((uToIndex * vec4(uEye, 1.0)).xyz, mat3(uToIndex) * ray, from, what);
  if (what == NOTHING) discard;
  gl_FragDepth = depthOf(t);
  vec3 place = uEye + t * ray;
  if (what == CAP) { draw(uCapTone * (isTrust() ? vec3(0.5) : uAlbedo), 1.0); return; }
  vec3 texel = (uToTexture * vec4(place, 1.0)).xyz;
  bool local = isLocal();
  vec3 normal = vec3(0.0);
  if (local || uLook != MATTE || isTrust()) {
    normal = -normalize(transpose(mat3(uToIndex)) * gradient((uToIndex * vec4(place, 1.0)).xyz));
  }
  float facing = abs(dot(normal, ray));
  if (isTrust()) { draw(trusted(doubt(texel)) * (0.4 + 0.6 * facing), 1.0); return; }
  vec3 color, light = lightOf(texture(uLight, texel));
  if (local) color = uGain * uWhite * uAlbedo / max(most(uAlbedo), 1e-9) * max(-dot(normal, ray), uBothSides ? facing : 0.0);
  else color = uGain * uAlbedo * light;
  if (uLook == SHINY) color = 0.8 * color + gloss(normal, ray, local ? vec3(uWhite) : light);
  draw(curve(color), uLook == TRANSLUCENT ? 1.0 - pow(0.62, 1.0 / max(facing, 0.12)) : 1.0);
}
