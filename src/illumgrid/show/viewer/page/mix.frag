// One slice of light: the weighted sum of its parts. What is clamped is what is shown, after interpolation.
const int WIDE = 2048;               // of the textures of parts

uniform highp sampler2D uParts[4];   // four parts each, one texel after the other
uniform vec4 uShares[16];            // what each part adds to the channels
uniform highp usampler3D uPlaces;    // where the parts of a texel lie, from 1; 0 where it has none
uniform bool uSome;                  // whether only some texels have parts
uniform vec2 uShape;
uniform int uSlice;

out vec4 light;

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  int place = uSome ? int(texelFetch(uPlaces, ivec3(at, uSlice), 0).r) - 1 : at.x + int(uShape.x) * (at.y + int(uShape.y) * uSlice);
  light = vec4(0.0);
  if (place < 0) return;
  ivec2 part = ivec2(place % WIDE, place / WIDE);
  vec4 values[4] = vec4[4](texelFetch(uParts[0], part, 0), texelFetch(uParts[1], part, 0), texelFetch(uParts[2], part, 0), texelFetch(uParts[3], part, 0));
  for (int k = 0; k < 4; k++) light += mat4(uShares[4 * k], uShares[4 * k + 1], uShares[4 * k + 2], uShares[4 * k + 3]) * values[k];
  light = clamp(light, -65504.0, 65504.0);
}
