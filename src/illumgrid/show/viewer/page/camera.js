// The camera: a turntable about a point. All in stage coordinates, right-handed like the world: no picture is mirrored.

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
export const sum = (...terms) => [0, 1, 2].map((k) => terms.reduce((s, [w, v]) => s + w * v[k], 0));
const unit = (v) => sum([1 / Math.hypot(...v), v]);

const STEEPEST = 1.5533; // 89 degrees: at the poles right and left are undefined

// Right, up and forward of a view; `axes` are the world's right, front and up.
export function facing({ azimuth, elevation }, axes) {
  const [right, front, up] = axes;
  const level = Math.cos(elevation);
  const forward = sum([-level * Math.cos(azimuth), front], [-level * Math.sin(azimuth), right], [-Math.sin(elevation), up]);
  const across = unit(cross(forward, up));
  return { right: across, up: cross(across, forward), forward };
}

export function eyeOf(view, axes) {
  return sum([1, view.target], [-view.distance, facing(view, axes).forward]);
}

// The nearest view in which the outline fits the picture: each of its points bounds the eye's place on either side.
export function fitted(opening, axes, aspect, tangent) {
  const { right, up, forward } = facing(opening, axes);
  const points = opening.outline.map((p) => [dot(p, right), dot(p, up), dot(p, forward)]);
  const place = [], depth = [];
  [aspect, 1].forEach((wide, k) => {
    const slope = (tangent * wide) / 1.08;
    const above = Math.max(...points.map((p) => p[k] - p[2] * slope));
    const below = Math.min(...points.map((p) => p[k] + p[2] * slope));
    place.push(0.5 * (above + below));
    depth.push((0.5 * (below - above)) / slope);
  });
  const ahead = Math.min(...depth);
  const depths = points.map((p) => p[2]);
  const distance = 0.5 * (Math.min(...depths) + Math.max(...depths)) - ahead;
  const target = sum([place[0], right], [place[1], up], [ahead + distance, forward]);
  return { azimuth: opening.azimuth, elevation: opening.elevation, distance, target };
}

export function orbited(view, byAzimuth, byElevation) {
  const elevation = Math.max(-STEEPEST, Math.min(STEEPEST, view.elevation + byElevation));
  return { ...view, azimuth: view.azimuth + byAzimuth, elevation };
}

// `x` and `y` in halves of the picture's height.
export function panned(view, axes, tangent, x, y) {
  const { right, up } = facing(view, axes);
  const reach = view.distance * tangent;
  return { ...view, target: sum([1, view.target], [-x * reach, right], [-y * reach, up]) };
}

export function zoomed(view, factor) {
  return { ...view, distance: Math.max(1e-3, Math.min(100, view.distance * factor)) };
}
