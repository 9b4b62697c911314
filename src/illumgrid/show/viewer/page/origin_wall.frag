// Where gathered rays start on the front of a wall: as origin.frag.
uniform sampler3D uWalls;
uniform vec3 uEye, uNormal;
uniform vec2 uTexels, uOffset;
uniform float uRow, uId;

in vec3 vRay;
in vec2 vPlace;

layout(location = 1) out vec4 normal_;
layout(location = 2) out vec4 light_;

void main() {
  gl_FragDepth = depthOf(length(vRay));
  vec2 texel = uOffset + clamp(vPlace * uTexels, vec2(0.5), uTexels - 0.5);
  color_ = vec4(uEye + vRay, uId);
  normal_ = vec4(uNormal, 1.0);
  light_ = vec4(lightOf(texture(uWalls, vec3(texel / vec2(textureSize(uWalls, 0).xy), uRow))), groundShare(vPlace));
}
