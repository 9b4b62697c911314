// What gathered rays meet of one field: the light that its grid holds there, or for shadow rays nothing but the shadow.
uniform float uId;

void main() {
  Ray ray = gathered();
  if (ray.id < 0.0 || most(ray.worth) <= 0.0) discard;
  vec3 start = (uToIndex * vec4(ray.start, 1.0)).xyz, ahead = mat3(uToIndex) * ray.ahead;
  int what = SURFACE;
  float t = 0.0;
  ivec3 cell = clamp(ivec3(floor(start)), ivec3(0), textureSize(uField, 0) - 2);
  vec4 near, far;
  corners(cell, near, far);
  float from = uBothSides ? 0.004 / length(ahead) : 0.0;
  bool dips = ray.id == uId && cubic(near, far, start - vec3(cell), ahead).y > 0.0;   // under the surface that it leaves
  for (int k = 0; k < 4 && !dips; k++) {
    t = march(start, ahead, from, what);
    if (what != SURFACE || uThrough <= 0.0 || chance(float(k) + 5.0 + float(uAim)) > uThrough) break;
    from = t + 0.004 / length(ahead);
    what = NOTHING;
  }
  if (what == NOTHING || t >= ray.reach) discard;
  gl_FragDepth = depthOf(t);
  vec3 texel = (uToTexture * vec4(ray.start + t * ray.ahead, 1.0)).xyz;
  if (uAim == OPEN && !uOnward && !uBothSides && what == SURFACE && (t < uNear || !trusted(uLight, texel * vec3(textureSize(uLight, 0)) - 0.5, ivec3(0), textureSize(uLight, 0) - 1))) {
    place_ = vec4(ray.start + t * ray.ahead, uId);
    normal_ = vec4(-normalize(transpose(mat3(uToIndex)) * gradient(start + t * ahead)), 0.0);
    color_ = vec4(0.0);
    return;
  }
  color_ = vec4(uAim == OPEN || uAim == MIRROR ? ray.worth * uAlbedo * lightOf(texture(uLight, texel)) : vec3(0.0), 1.0);
}
