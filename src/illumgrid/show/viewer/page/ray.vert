// One triangle that covers the picture; every pixel's ray.
uniform vec3 uRight, uUp, uForward;  // right and up as long as half the picture at distance 1
uniform vec2 uJitter;                // in halves of the picture

out vec3 vRay;
out vec2 vPlace;

void main() {
  vec2 place = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
  vRay = uForward + (place.x + uJitter.x) * uRight + (place.y + uJitter.y) * uUp;
  vPlace = 0.5 * place + 0.5;
  gl_Position = vec4(place, 0.0, 1.0);
}
