// The front of a wall: its own light texture, (u, v, sweep).
uniform sampler3D uWalls;
uniform vec3 uNormal;
uniform vec2 uTexels, uOffset;       // of this wall, within the texture of all
uniform float uRow;                  // texture coordinate of the sweep
uniform vec3 uAlbedo, uEmission;     // emission as the exposure shows it
uniform vec3 uLocalColor;
uniform sampler2D uFront;
uniform bool uPeel, uBase;           // whether colours of a second quantity alone are drawn: walls have none

in vec3 vRay;
in vec2 vPlace;

void finish(vec3 color) {
  draw(mix(vec3(uGround), color, groundShare(vPlace)), 1.0);
}

void main() {
  float depth = depthOf(length(vRay));
  if (uPeel && depth <= texelFetch(uFront, ivec2(gl_FragCoord.xy), 0).r + 1e-6) discard;
  gl_FragDepth = depth;
  if (uBase) { color_ = vec4(0.0); return; }
  vec2 texel = uOffset + clamp(vPlace * uTexels, vec2(0.5), uTexels - 0.5);
  vec3 light = lightOf(texture(uWalls, vec3(texel / vec2(textureSize(uWalls, 0).xy), uRow)));
  float facing = abs(dot(uNormal, normalize(vRay)));
  if (isTrust()) finish(vec3(0.5 * uCapTone * facing));
  else if (isLocal()) finish(curve(uGain * uWhite * uLocalColor * facing));
  else finish(curve(uGain * (uAlbedo * light + uEmission)));
}
