// A layer into the picture, or the picture to the screen.
uniform sampler2D uPicture;
uniform bool uEncode;                // to sRGB (IEC 61966-2-1)

in vec2 vPlace;
out vec4 color;

void main() {
  color = texture(uPicture, vPlace);
  if (uEncode) {
    vec3 c = clamp(color.rgb, 0.0, 1.0);
    color = vec4(mix(1.055 * pow(max(c, 1e-9), vec3(1.0 / 2.4)) - 0.055, 12.92 * c, lessThanEqual(c, vec3(0.0031308))), 1.0);
  }
}
