// What gathered rays find where nothing stands in their way: the sky, or the light that they were sent to.
uniform vec4 uDiscs[8];              // axes of discs of the sky and cosines of their half-angles, for coats
uniform vec3 uDiscShine[8];
uniform vec3 uSky[25];               // coefficients as in skies.js
uniform bool uPictured;              // whether there is an image of the sky

vec3 sky(vec3 ray) {
  float x = dot(uSkyAxes[0], ray), y = dot(uSkyAxes[1], ray), z = dot(uSkyAxes[2], ray), xx = x * x, yy = y * y, zz = z * z;
  return 0.2820947918 * uSky[0] + 0.4886025119 * (y * uSky[1] + z * uSky[2] + x * uSky[3])
    + 1.0925484306 * (x * y * uSky[4] + y * z * uSky[5] + x * z * uSky[7]) + 0.3153915653 * (3.0 * zz - 1.0) * uSky[6]
    + 0.5462742153 * (xx - yy) * uSky[8] + 0.5900435899 * (y * (3.0 * xx - yy) * uSky[9] + x * (xx - 3.0 * yy) * uSky[15])
    + 2.8906114426 * x * y * z * uSky[10] + 0.4570457995 * (5.0 * zz - 1.0) * (y * uSky[11] + x * uSky[13])
    + 0.3731763326 * z * (5.0 * zz - 3.0) * uSky[12] + 1.4453057213 * z * (xx - yy) * uSky[14]
    + 2.503342942 * x * y * (xx - yy) * uSky[16] + 1.7701307698 * (y * z * (3.0 * xx - yy) * uSky[17] + x * z * (xx - 3.0 * yy) * uSky[23])
    + 0.9461746958 * x * y * (7.0 * zz - 1.0) * uSky[18] + 0.6690465436 * z * (7.0 * zz - 3.0) * (y * uSky[19] + x * uSky[21])
    + 0.1057855469 * (35.0 * zz * zz - 30.0 * zz + 3.0) * uSky[20] + 0.4730873479 * (xx - yy) * (7.0 * zz - 1.0) * uSky[22]
    + 0.6258357354 * (xx * (xx - 3.0 * yy) - yy * (3.0 * xx - yy)) * uSky[24];
}

void main() {
  Ray ray = gathered();
  if (ray.id < 0.0) discard;
  gl_FragDepth = uAim == LAMP ? depthOf(0.9999 * ray.reach) : 1.0;
  vec3 light = uAim == OPEN || uAim == MIRROR ? sky(ray.ahead) : uAim == IMAGE ? vec3(0.0) : uShine;
  if (uPictured && uAim != DISC && uAim != LAMP) {
    vec3 soft, hard;
    float asked;
    image(placeOf(ray.ahead), soft, hard, asked);
    light += uAim == OPEN ? soft : uAim == IMAGE ? hard : soft + hard;
  }
  if (uAim == MIRROR) for (int k = 0; k < 8; k++) if (dot(uDiscs[k].xyz, ray.ahead) > uDiscs[k].w) light += uDiscShine[k];
  color_ = vec4(ray.worth * light, 1.0);
}
