// What fields and walls share: depth, which light is shown where, the tone curve, and looks at display time.
const int MATTE = 0, SHINY = 1, TRANSLUCENT = 2;

uniform float uWhite, uGain;         // display radiance of white under the local lamp; 2 to the power of the exposure in EV
uniform float uLocalUpTo;            // pixels left of this column show local light
uniform bool uGrey;                  // light textures hold (light, error) in place of (red, green, blue, error)
uniform int uLook;
uniform float uCapTone;              // display radiance of a cut
uniform vec2 uTrust;                 // relative errors at the ends of the scale; 0 where light is shown
uniform vec3 uScale[5], uHatch[2];   // its colours, in equal steps of the logarithm, and those of holes
uniform vec3 uLamp;                  // direction to the lamp of the shiny look, beside the eye

uniform bool uRaw;                   // no tone curve, and no coats
uniform float uGround;               // display radiance of the background, into which a floor under the sky fades; else below 0

layout(location = 0) out vec4 color_;

float depthOf(float t) { return t / (1.0 + t); }
float distanceOf(float depth) { return depth / (1.0 - depth); }
bool isLocal() { return gl_FragCoord.x < uLocalUpTo; }
bool isTrust() { return uTrust.y > 0.0; }
vec3 lightOf(vec4 texel) { return max(uGrey ? texel.rrr : texel.rgb, 0.0); }
float errorOf(vec4 texel) { return uGrey ? texel.g : texel.a; }

// How much of a wall is left of it, as it fades into the background.
float groundShare(vec2 place) { return uGround < 0.0 ? 1.0 : smoothstep(0.0, 0.6, 1.0 - length(2.0 * place - 1.0)); }

void draw(vec3 color, float alpha) { color_ = vec4(clamp(color, 0.0, uRaw ? 65504.0 : 1.0) * alpha, alpha); }

// Exposed radiance as the screen shows it: `curve` of illumgrid.tone.
vec3 curve(vec3 light) {
  float peak = max(light.r, max(light.g, light.b)), room = 1.0 - uWhite;
  if (uRaw || peak <= uWhite) return light;
  float rolled = 1.0 - room * room / (peak - uWhite + room), faded = 1.0 - 1.0 / (0.15 * (peak - rolled) + 1.0);
  return rolled * mix(light / peak, vec3(1.0), faded);
}

// A highlight and a faint rim, as strong as the stored light allows: what lies in the dark does not shine.
vec3 gloss(vec3 normal, vec3 ray, vec3 light) {
  float shown = clamp(dot(light, vec3(1.0 / 3.0)) / uWhite, 0.0, 1.0);
  float peak = pow(max(dot(normal, normalize(uLamp - ray)), 0.0), 70.0);
  float rim = pow(1.0 - clamp(-dot(normal, ray), 0.0, 1.0), 5.0);
  return uGain * vec3(0.75 * peak + 0.25 * rim) * shown;
}

// Display-linear colour of a relative error on a logarithmic scale; holes (negative) are hatched.
vec3 trusted(float error) {
  if (error < 0.0) {
    float stripe = fract((gl_FragCoord.x + gl_FragCoord.y) / 10.0);
    return stripe < 0.5 ? uHatch[0] : uHatch[1];
  }
  float x = 4.0 * clamp(log(max(error, 1e-9) / uTrust.x) / log(uTrust.y / uTrust.x), 0.0, 1.0);
  int k = min(int(x), 3);
  return mix(uScale[k], uScale[k + 1], x - float(k));
}
