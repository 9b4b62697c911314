// Where gathered rays start: what a pixel shows of one field, or of one wall where its shader comes before.
uniform vec3 uEye;
uniform float uId;                   // of this surface: fields first, then walls

in vec3 vRay;

layout(location = 1) out vec4 normal_;   // and the variance that the grid knows of
layout(location = 2) out vec4 light_;

void main() {
  vec3 ray = normalize(vRay);
  int what;
  float t = 0.0, facing = 1.0;
  vec3 place, normal;
  for (int k = 0; k < 4; k++) {      // through what is seen through, by chance
    t = march_clipped(uEye, ray, t, what);
    if (what == NOTHING) break;
    place = uEye + t * ray;
    normal = -normalize(transpose(mat3(uToIndex)) * gradient((uToIndex * vec4(place, 1.0)).xyz));
    facing = -dot(normal, ray);
    if (what != SURFACE || chance(float(k)) <= opaque(abs(facing))) break;
    t += 0.004 / length(mat3(uToIndex) * ray);
    what = NOTHING;
  }
  if (what == NOTHING) discard;
  gl_FragDepth = depthOf(t);
  vec3 texel = (uToTexture * vec4(place, 1.0)).xyz;
  vec4 found = texture(uLight, texel);
  color_ = vec4(place, what != SURFACE || (uBothSides && facing < 0.0) ? -1.0 : uId);   // inner sides keep their lookups
  light_ = vec4(lightOf(found), 1.0);
  float error = errorOf(found) * dot(light_.rgb, vec3(1.0 / 3.0));
  normal_ = vec4(normal, error * error);
}
