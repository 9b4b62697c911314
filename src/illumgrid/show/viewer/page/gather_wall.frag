// What gathered rays meet of one wall.
uniform sampler3D uWalls;
uniform vec3 uCorner, uEdgeU, uEdgeV, uNormal, uAlbedo, uEmission;
uniform vec2 uTexels, uOffset;
uniform float uRow, uId;

void main() {
  Ray ray = gathered();
  if (ray.id < 0.0 || ray.id == uId || max(ray.worth.r, max(ray.worth.g, ray.worth.b)) <= 0.0) discard;
  float toward = dot(ray.ahead, uNormal), t = dot(uCorner - ray.start, uNormal) / toward;
  vec3 within = ray.start + t * ray.ahead - uCorner;
  mat2 gram = mat2(dot(uEdgeU, uEdgeU), dot(uEdgeU, uEdgeV), dot(uEdgeU, uEdgeV), dot(uEdgeV, uEdgeV));
  vec2 place = inverse(gram) * vec2(dot(within, uEdgeU), dot(within, uEdgeV));
  if (!(t > 0.0 && t < ray.reach && place == clamp(place, 0.0, 1.0))) discard;
  gl_FragDepth = depthOf(t);
  ivec3 first = ivec3(uOffset, 0), last = ivec3(uOffset + uTexels, textureSize(uWalls, 0).z) - 1;
  vec3 node = vec3(uOffset + place * uTexels, uRow * float(last.z + 1)) - 0.5;
  if (uAim == OPEN && !uOnward && toward < 0.0 && (t < uNear || !trusted(uWalls, node, first, last))) {
    place_ = vec4(ray.start + t * ray.ahead, uId);
    normal_ = vec4(uNormal, 0.0);
    color_ = vec4(0.0);
    return;
  }
  vec2 texel = uOffset + clamp(place * uTexels, vec2(0.5), uTexels - 0.5);
  vec3 light = lightOf(texture(uWalls, vec3(texel / vec2(textureSize(uWalls, 0).xy), uRow)));
  if (uAim == OPEN || uAim == MIRROR) light = ray.worth * (uAlbedo * light + (uAim == MIRROR ? uEmission : vec3(0.0)));
  else light = vec3(0.0);
  color_ = vec4(toward < 0.0 ? light : vec3(0.0), 1.0);   // its back is dark
}
