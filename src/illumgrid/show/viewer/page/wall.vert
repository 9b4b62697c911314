// A parallelogram, seen by the same camera as the rays.
uniform vec3 uEye, uRight, uUp, uForward, uCorner, uEdgeU, uEdgeV;
uniform vec2 uJitter;

out vec3 vRay;
out vec2 vPlace;

void main() {
  vPlace = vec2(gl_VertexID & 1, gl_VertexID >> 1);
  vRay = uCorner + vPlace.x * uEdgeU + vPlace.y * uEdgeV - uEye;
  float depth = dot(vRay, uForward);
  vec2 seen = vec2(dot(vRay, uRight) / dot(uRight, uRight), dot(vRay, uUp) / dot(uUp, uUp));
  gl_Position = vec4(seen - uJitter * depth, 0.0, depth);
}
