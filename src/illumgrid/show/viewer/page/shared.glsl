// What fields and walls share: the ray's depth, whose light is shown where, and the looks at display time.
const int MATTE = 0, SHINY = 1, TRANSLUCENT = 2;

uniform float uWhite, uGain;         // display radiance of white under the local lamp; 2 to the stops of exposure
uniform float uLocalFrom;            // pixels from this column on show local light
uniform int uLook;
uniform float uTrust;                // 0, or the relative error that gets the last colour
uniform vec3 uScale[4];              // its colours, evenly from 0 on
uniform vec3 uLamp;                  // direction to the lamp of the shiny look, at the shoulder of the beholder

out vec4 color_;

float depthOf(float t) { return t / (1.0 + t); }
float distanceOf(float depth) { return depth / (1.0 - depth); }
bool isLocal() { return gl_FragCoord.x >= uLocalFrom; }

void draw(vec3 color, float alpha) { color_ = vec4(clamp(color, 0.0, 1.0) * alpha, alpha); }

// A highlight and a faint rim, as strong as the stored light allows: what lies in the dark does not shine.
vec3 gloss(vec3 normal, vec3 ray, vec3 light) {
  float shown = clamp(dot(light, vec3(1.0 / 3.0)) / uWhite, 0.0, 1.0);
  float peak = pow(max(dot(normal, normalize(uLamp - ray)), 0.0), 70.0);
  float rim = pow(1.0 - clamp(-dot(normal, ray), 0.0, 1.0), 5.0);
  return uGain * vec3(0.75 * peak + 0.25 * rim) * shown;
}

// Display-linear colour of a relative error; holes are hatched.
vec3 trusted(float error) {
  if (error < 0.0) {
    float stripe = fract((gl_FragCoord.x + gl_FragCoord.y) / 10.0);
    return stripe < 0.5 ? vec3(0.42) : vec3(0.09);
  }
  float x = clamp(error / uTrust, 0.0, 1.0);
  int k = min(int(3.0 * x), 2);
  return mix(uScale[k], uScale[k + 1], 3.0 * x - float(k));
}
