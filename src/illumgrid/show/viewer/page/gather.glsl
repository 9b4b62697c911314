// One ray from each pixel's origin: cosine-distributed, or to a light that shadow rays ask for.
const int OPEN = 0, DISC = 1, LAMP = 2;

uniform sampler2D uPlace, uNormals;  // of origins, see origin.frag
uniform int uAim;
uniform vec2 uTurn;                  // this ray's place in the unit square, before each pixel's own shift
uniform vec3 uAxis;                  // of a disc of the sky,
uniform float uCosine;               // and the cosine of its half-angle
uniform vec3 uLamp0, uLampU, uLampV, uLampNormal;
uniform vec3 uShine;                 // radiance of the disc or the lamp, as the exposure shows it

struct Ray { vec3 start, ahead; float id, reach, worth; };

// J. Jimenez, "Next generation post processing in Call of Duty", SIGGRAPH 2014: near pixels differ most.
float noise(vec2 pixel) { return fract(52.9829189 * fract(dot(pixel, vec2(0.06711056, 0.00583715)))); }

void basisOf(vec3 n, out vec3 a, out vec3 b) {   // Duff et al., JCGT 6(1), 2017
  float s = n.z < 0.0 ? -1.0 : 1.0, c = -1.0 / (s + n.z), d = n.x * n.y * c;
  a = vec3(1.0 + s * n.x * n.x * c, s * d, -s * n.x);
  b = vec3(d, s + n.y * n.y * c, -n.y);
}

// `worth` turns the radiance that the ray finds into light of the origin, in the units of the light's textures.
Ray gathered() {
  vec4 place = texelFetch(uPlace, ivec2(gl_FragCoord.xy), 0);
  vec3 normal = texelFetch(uNormals, ivec2(gl_FragCoord.xy), 0).xyz, a, b;
  vec2 shift = gl_FragCoord.xy + 31.0 * float(uAim), u = fract(uTurn + vec2(noise(shift), noise(shift + 39.117666)));
  Ray ray = Ray(place.xyz, normal, place.w, 1e9, 1.0);
  float angle = 6.2831853 * u.y;
  if (uAim == LAMP) {
    vec3 to = uLamp0 + u.x * uLampU + u.y * uLampV - place.xyz;
    float far = length(to);
    ray.ahead = to / far;
    ray.reach = far;
    ray.worth = max(dot(ray.ahead, normal), 0.0) * max(-dot(ray.ahead, uLampNormal), 0.0) * length(cross(uLampU, uLampV)) / (3.14159265 * far * far);
  } else if (uAim == DISC) {
    float cosine = mix(1.0, uCosine, u.x), sine = sqrt(max(0.0, 1.0 - cosine * cosine));
    basisOf(uAxis, a, b);
    ray.ahead = sine * (cos(angle) * a + sin(angle) * b) + cosine * uAxis;
    ray.worth = 2.0 * (1.0 - uCosine) * max(dot(ray.ahead, normal), 0.0);
  } else {
    float sine = sqrt(u.x);
    basisOf(normal, a, b);
    ray.ahead = sine * (cos(angle) * a + sin(angle) * b) + sqrt(1.0 - u.x) * normal;
  }
  return ray;
}
