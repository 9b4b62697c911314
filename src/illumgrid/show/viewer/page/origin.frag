// Where gathered rays start: what a pixel shows of one field, or of one wall where its shader comes before.
uniform vec3 uEye;
uniform float uId;                   // of this surface: fields first, then walls

in vec3 vRay;

layout(location = 1) out vec4 normal_;   // and the variance that the grid knows of
layout(location = 2) out vec4 light_;

void main() {
  vec3 ray = normalize(vRay);
  int what;
  float t = march((uToIndex * vec4(uEye, 1.0)).xyz, mat3(uToIndex) * ray, 0.0, what);
  if (what == NOTHING) discard;
  gl_FragDepth = depthOf(t);
  vec3 place = uEye + t * ray, texel = (uToTexture * vec4(place, 1.0)).xyz;
  vec4 found = texture(uLight, texel);
  color_ = vec4(place, what == CAP ? -1.0 : uId);
  light_ = vec4(lightOf(found), 1.0);
  float error = errorOf(found) * dot(light_.rgb, vec3(1.0 / 3.0));
  normal_ = vec4(-normalize(transpose(mat3(uToIndex)) * gradient((uToIndex * vec4(place, 1.0)).xyz)), error * error);
}
