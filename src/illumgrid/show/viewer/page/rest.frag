// The still picture with gathered light: (N0 lookup + N gathered) / (N0 + N).
uniform sampler2D uStill, uLinear, uMean, uCoat;   // as shown, before the tone curve and coats, and the means of blend.frag
uniform sampler2D uColors;           // of a second quantity, and how much of the pixel has them
uniform bool uTint;
uniform float uRays;

void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  vec4 known = texelFetch(uMean, pixel, 0);
  vec3 before = texelFetch(uLinear, pixel, 0).rgb, after = max(before + uGain * uRays / (uRays + known.a) * known.rgb, 0.0);
  vec4 coat = texelFetch(uCoat, pixel, 0);
  vec4 base = uTint ? texelFetch(uColors, pixel, 0) : vec4(0.0);
  vec3 still = texelFetch(uStill, pixel, 0).rgb, bright = vec3(0.2126, 0.7152, 0.0722);
  vec3 c = still + (1.0 - base.a) * (curve(after) - curve(before)) + base.rgb * dot(curve(after) - curve(before), bright);
  if (uTint) after = (1.0 - base.a) * after + base.rgb * dot(curve(after), bright);
  if (coat.a < 0.9999) c = mix(still, curve(coat.a * after + uGain * coat.rgb), uRays / (uRays + 8.0));
  c = clamp(c, 0.0, 1.0);
  color_ = vec4(mix(1.055 * pow(max(c, 1e-9), vec3(1.0 / 2.4)) - 0.055, 12.92 * c, lessThanEqual(c, vec3(0.0031308))), 1.0);
}
