// One ray from each pixel's origin: cosine-distributed, or aimed at a light.
const int OPEN = 0, DISC = 1, LAMP = 2, MIRROR = 3, IMAGE = 4;

uniform sampler2D uPlace, uNormals;  // of origins, see origin.frag
uniform int uAim;
uniform vec2 uTurn;                  // this ray's place in the unit square, before each pixel's own shift
uniform vec3 uAxis;                  // of a disc of the sky,
uniform float uCosine;               // and the cosine of its half-angle
uniform vec3 uLamp0, uLampU, uLampV, uLampNormal;
uniform vec3 uShine;                 // radiance of the disc or the lamp, as the exposure shows it
uniform vec3 uEyeAt;
uniform sampler2D uImage;            // of the sky: radiance as the exposure shows it, and the sum up to each pixel of the excess that rays aim at
uniform float uSoft;                 // mean colour up to which escaping rays find a pixel; rays aim at the excess
uniform vec3 uSkyAxes[3];            // right, back and up
uniform float uCoats[16];            // roughness of each surface's coat, below 0 without
uniform bool uOnward;                // from where the first ray ended too soon: this one ends where it lands
uniform float uKept[48];             // albedos of the surfaces, three numbers each
uniform float uNear, uAlike;         // shortest ray that may end, and by how much nodes of one cell may differ: see illumgrid.grid.cache

layout(location = 1) out vec4 place_;    // where a ray goes on that is not to end there, and its surface: -1 for none
layout(location = 2) out vec4 normal_;

struct Ray { vec3 start, ahead; float id, reach; vec3 worth; };

vec4 pixel(int k, ivec2 size) { return texelFetch(uImage, ivec2(k % size.x, k / size.x), 0); }
float bright(vec3 light) { return dot(light, vec3(1.0 / 3.0)); }
float heightOf(float y, ivec2 size) { return 3.14159265 * (0.5 - y / float(size.y)); }

// Light of the image at a place in pixels, bilinear: `soft` is found by escaping rays, `hard` is the excess that rays aim at, `asked` its density.
void image(vec2 place, out vec3 soft, out vec3 hard, out float asked) {
  ivec2 size = textureSize(uImage, 0);
  vec2 at = vec2(place.x, clamp(place.y, 0.5, float(size.y) - 0.5)) - 0.5, f = fract(at);
  soft = hard = vec3(0.0);
  asked = 0.0;
  for (int k = 0; k < 4; k++) {
    ivec2 corner = ivec2(floor(at)) + ivec2(k & 1, k >> 1);
    corner = ivec2((corner.x + size.x) % size.x, min(corner.y, size.y - 1));
    vec3 light = texelFetch(uImage, corner, 0).rgb;
    vec2 w = mix(1.0 - f, f, vec2(k & 1, k >> 1));
    float share = w.x * w.y, kept = min(1.0, uSoft / max(bright(light), 1e-20));
    soft += share * kept * light;
    hard += share * (1.0 - kept) * light;
    asked += share * (1.0 - kept) * bright(light) * cos(heightOf(float(corner.y) + 0.5, size));
  }
}

vec2 placeOf(vec3 ray) {
  vec2 size = vec2(textureSize(uImage, 0));
  float x = dot(uSkyAxes[0], ray), y = dot(uSkyAxes[1], ray);
  return size * vec2((x == 0.0 && y == 0.0 ? 0.0 : atan(x, y)) / 6.2831853 + 0.5, acos(clamp(dot(uSkyAxes[2], ray), -1.0, 1.0)) / 3.14159265);
}

// Aims at the excess: at a pixel by its brightness, then at a place about it, so that the density is bilinear, too.
void toImage(inout Ray ray, vec3 normal, vec2 u) {
  ivec2 size = textureSize(uImage, 0);
  int low = 0, high = size.x * size.y - 1;
  float total = pixel(high, size).a, wanted = u.x * total;
  while (low < high) {
    int middle = (low + high) / 2;
    if (pixel(middle, size).a <= wanted) low = middle + 1; else high = middle;
  }
  float before = low > 0 ? pixel(low - 1, size).a : 0.0;
  vec2 v = vec2(clamp((wanted - before) / max(pixel(low, size).a - before, 1e-20), 0.0, 1.0), u.y);
  vec2 place = vec2(low % size.x, low / size.x) + 0.5 + mix(sqrt(2.0 * v) - 1.0, 1.0 - sqrt(max(2.0 - 2.0 * v, 0.0)), step(0.5, v));
  place.y = float(size.y) - abs(float(size.y) - abs(place.y));
  float up = heightOf(place.y, size), azimuth = 6.2831853 * (place.x / float(size.x) - 0.5), asked;
  ray.ahead = cos(up) * (sin(azimuth) * uSkyAxes[0] + cos(azimuth) * uSkyAxes[1]) + sin(up) * uSkyAxes[2];
  vec3 soft, hard;
  image(place, soft, hard, asked);
  ray.worth *= max(dot(ray.ahead, normal), 0.0) * cos(up) * 6.2831853 / float(size.x * size.y) * total / max(asked, 1e-20);
}

// Whether a ray may end between these nodes of light, which lie from `first` to `last`.
bool trusted(sampler3D lights, vec3 node, ivec3 first, ivec3 last) {
  ivec3 cell = ivec3(clamp(node, vec3(first), vec3(last)));
  float low = 1e9, high = 0.0;
  for (int k = 0; k < 8; k++) {
    vec4 texel = texelFetch(lights, min(cell + ivec3(k & 1, (k >> 1) & 1, k >> 2), last), 0);
    if (errorOf(texel) < 0.0) return false;
    float light = bright(lightOf(texel));
    low = min(low, light);
    high = max(high, light);
  }
  return high - low <= uAlike;
}

// J. Jimenez, "Next generation post processing in Call of Duty", SIGGRAPH 2014: near pixels differ most.
float noise(vec2 pixel) { return fract(52.9829189 * fract(dot(pixel, vec2(0.06711056, 0.00583715)))); }

void basisOf(vec3 n, out vec3 a, out vec3 b) {   // Duff et al., JCGT 6(1), 2017
  float s = n.z < 0.0 ? -1.0 : 1.0, c = -1.0 / (s + n.z), d = n.x * n.y * c;
  a = vec3(1.0 + s * n.x * n.x * c, s * d, -s * n.x);
  b = vec3(d, s + n.y * n.y * c, -n.y);
}

// The reflected ray of a rough coat: Heitz, JCGT 7(4), 2018; Schlick, CGF 13(3), 1994.
void mirror(inout Ray ray, vec3 n, float rough, vec2 u) {
  float alpha = max(rough * rough, 1e-3), angle = 6.2831853 * u.y;
  vec3 a, b, view = normalize(uEyeAt - ray.start);
  basisOf(n, a, b);
  vec3 v = vec3(dot(a, view), dot(b, view), max(dot(n, view), 1e-3)), s = normalize(vec3(alpha * v.xy, v.z));
  vec3 p = length(s.xy) > 0.0 ? vec3(-s.y, s.x, 0.0) / length(s.xy) : vec3(1.0, 0.0, 0.0), q = cross(s, p);
  float x = sqrt(u.x) * cos(angle), y = mix(sqrt(max(1.0 - x * x, 0.0)), sqrt(u.x) * sin(angle), 0.5 * (1.0 + s.z));
  vec3 h = x * p + y * q + sqrt(max(0.0, 1.0 - x * x - y * y)) * s;
  h = normalize(vec3(alpha * h.xy, max(h.z, 0.0)));
  vec3 d = 2.0 * dot(v, h) * h - v;
  float to = 0.5 * (sqrt(1.0 + alpha * alpha * (1.0 / (v.z * v.z) - 1.0)) - 1.0), from = 0.5 * (sqrt(1.0 + alpha * alpha * (1.0 / max(d.z * d.z, 1e-6) - 1.0)) - 1.0);
  ray.ahead = d.x * a + d.y * b + d.z * n;
  ray.worth *= d.z > 0.0 ? (0.04 + 0.96 * pow(1.0 - clamp(dot(v, h), 0.0, 1.0), 5.0)) * (1.0 + to) / (1.0 + to + from) : 0.0;
}

// `worth` turns the radiance that the ray finds into light of the origin, in the units of the light's textures.
Ray gathered() {
  vec4 place = texelFetch(uPlace, ivec2(gl_FragCoord.xy), 0);
  vec3 normal = texelFetch(uNormals, ivec2(gl_FragCoord.xy), 0).xyz, a, b;
  vec2 shift = gl_FragCoord.xy + 31.0 * float(uAim), u = fract(uTurn + vec2(noise(shift), noise(shift + 39.117666)));
  Ray ray = Ray(place.xyz, normal, place.w, 1e9, vec3(1.0));
  if (uOnward && ray.id >= 0.0) ray.worth = vec3(uKept[3 * int(ray.id)], uKept[3 * int(ray.id) + 1], uKept[3 * int(ray.id) + 2]);
  place_ = vec4(0.0, 0.0, 0.0, -1.0);
  normal_ = vec4(0.0);
  float angle = 6.2831853 * u.y;
  if (uAim == LAMP) {
    vec3 to = uLamp0 + u.x * uLampU + u.y * uLampV - place.xyz;
    float far = length(to);
    ray.ahead = to / far;
    ray.reach = far;
    ray.worth *= max(dot(ray.ahead, normal), 0.0) * max(-dot(ray.ahead, uLampNormal), 0.0) * length(cross(uLampU, uLampV)) / (3.14159265 * far * far);
  } else if (uAim == DISC) {
    float cosine = mix(1.0, uCosine, u.x), sine = sqrt(max(0.0, 1.0 - cosine * cosine));
    basisOf(uAxis, a, b);
    ray.ahead = sine * (cos(angle) * a + sin(angle) * b) + cosine * uAxis;
    ray.worth *= 2.0 * (1.0 - uCosine) * max(dot(ray.ahead, normal), 0.0);
  } else if (uAim == IMAGE) {
    toImage(ray, normal, u);
  } else if (uAim == MIRROR) {
    float rough = ray.id < 0.0 ? -1.0 : uCoats[int(ray.id)];
    if (rough >= 0.0) mirror(ray, normal, rough, u); else ray.worth = vec3(0.0);
  } else {
    float sine = sqrt(u.x);
    basisOf(normal, a, b);
    ray.ahead = sine * (cos(angle) * a + sin(angle) * b) + sqrt(1.0 - u.x) * normal;
  }
  return ray;
}
