// Means over a pixel's rays: what gathered light differs by from the lookup, and how many rays the lookup is worth.
uniform sampler2D uOld, uFound, uPlace, uNormals, uKnown, uOldCoat, uMirror;
uniform vec3 uEyeAt;
uniform float uCoats[16], uOpaque[16];   // roughness of coats, below 0 without; how much of each surface is there
uniform float uShare;                // of this ray in the mean
uniform bool uTrial;                 // the variance that grids know of in place of the worth
uniform float uAlbedos[48];          // of each surface, three numbers
uniform float uTrust[48];            // variance of a ray and of a lookup, and that which grids know of in the mean

layout(location = 0) out vec4 mean;
layout(location = 1) out vec4 coat;  // what coats reflect, and the share of the light below that leaves through them

void main() {
  ivec2 pixel = ivec2(gl_FragCoord.xy);
  int id = int(texelFetch(uPlace, pixel, 0).w);
  vec4 now = vec4(0.0, 0.0, 0.0, 4096.0);
  if (id >= 0) {
    vec3 albedo = vec3(uAlbedos[3 * id], uAlbedos[3 * id + 1], uAlbedos[3 * id + 2]);
    float known = texelFetch(uNormals, pixel, 0).w, shape = uTrust[3 * id + 2] > 0.0 ? known / uTrust[3 * id + 2] : 1.0;
    vec4 lookup = texelFetch(uKnown, pixel, 0);  // and how much is seen of a surface that fades
    now.rgb = lookup.a * albedo * (texelFetch(uFound, pixel, 0).rgb - lookup.rgb);
    now.a = uTrial ? known : clamp(uTrust[3 * id] / max(uTrust[3 * id + 1] * max(shape, 0.1), 1e-20), 4.0, 4096.0);
  }
  vec4 over = vec4(0.0, 0.0, 0.0, 1.0);
  if (id >= 0 && uCoats[id] >= 0.0) {
    float facing = dot(normalize(uEyeAt - texelFetch(uPlace, pixel, 0).xyz), texelFetch(uNormals, pixel, 0).xyz);
    over = vec4(texelFetch(uMirror, pixel, 0).rgb / uOpaque[id], 0.96 * (1.0 - pow(1.0 - clamp(facing, 0.0, 1.0), 5.0)));
  }
  coat = mix(texelFetch(uOldCoat, pixel, 0), over, uShare);
  mean = mix(texelFetch(uOld, pixel, 0), now, uShare);
}
