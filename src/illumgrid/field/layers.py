"""The lights of a scene as layers, and the columns of light that each channel of a computation has.

Light is linear, so each light is stored separately: one layer for each name. All channels share their paths, and
differ in the columns of the tables here.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.field.lights import MOST_DEGREE, Distant, Harmonics, Sky, projected
from illumgrid.field.scene import Scene
from illumgrid.field.upright import sky_axes
from illumgrid.field.volume import Floats

SKY = "sky"
"""Name of the light that `Scene.background` is."""
HARMONICS = "sh"
"""Name of the light that stands for all distant lights of `Scene.in_harmonics`."""


class Layer(NamedTuple):
    """One light of a scene, or one of the basis functions of a `Harmonics`.

    Parameters
    ----------
    name : str
    color : (float, float, float)
        What its channels are multiplied by in the scene as it is: the light itself where `grey`, else 1; of a basis
        function the coefficient.
    grey : bool
        One channel holds it: it has one colour, and no surface has any.
    """

    name: str
    color: tuple[float, float, float]
    grey: bool


class Channel(NamedTuple):
    """One channel of a computation: colour number `color` of one layer, or of all light together (None)."""

    layer: Layer | None
    color: int

    @property
    def name(self) -> str:
        """Name, as in an EXR file."""
        suffix = "Y" if self.layer and self.layer.grey else "RGB"[self.color]
        return f"{self.layer.name}.{suffix}" if self.layer else suffix


def _sources(scene: Scene) -> list[tuple[str, Floats]]:
    """Names and colours (..., 3) of everything that emits light, except for `Harmonics`."""
    found = [(SKY, scene.background)]
    found += [(light.name, light.radiance) for light in scene.lights if not isinstance(light, Harmonics)]
    found += [(field.name, field.material.emission) for field in scene.fields]
    found += [(quad.light or quad.name, quad.material.emission) for quad in scene.quads]
    return [(name, color) for name, color in found if color.any()]


def colors_of(scene: Scene) -> list[Floats]:
    """All colours (..., 3) of surfaces and lights."""
    albedos = [f.material.albedo for f in scene.fields] + [q.material.albedo for q in scene.quads]
    smooth = [light.coefficients for light in scene.lights if isinstance(light, Harmonics)]
    return [*albedos, *(color for _, color in _sources(scene)), *smooth]


def is_grey(color: Floats) -> bool:
    """Whether colours (..., 3) have three equal channels."""
    return bool((color == color[..., :1]).all())


def layers_of(scene: Scene) -> tuple[Layer, ...]:
    """The layers of a scene, in the order sky, distant lights, fields and quads that emit."""
    plain = all(is_grey(f.material.albedo) for f in scene.fields) and all(
        is_grey(q.material.albedo) for q in scene.quads
    )
    groups: dict[str, list[Floats]] = {}
    for name, color in _sources(scene):
        groups.setdefault(name, []).append(color.reshape(-1, 3))
    layers = []
    for name, parts in groups.items():
        colors = np.concatenate(parts)
        brightest = colors[colors.max(axis=1).argmax()]
        top = int(brightest.argmax())
        one = np.allclose(colors, colors[:, top : top + 1] * (brightest / brightest[top]), rtol=1e-6, atol=0.0)
        grey = plain and bool(one)
        layers.append(Layer(name, tuple(brightest.tolist()) if grey else (1.0, 1.0, 1.0), grey))
    for light in scene.lights:
        if isinstance(light, Harmonics):
            layers += [Layer(f"{light.name}.{b}", tuple(c.tolist()), plain) for b, c in enumerate(light.coefficients)]
    return tuple(layers)


def _seen(channel: Channel, name: str, color: Floats) -> Floats:
    """The columns (...) of a channel for the colour (..., 3) of a light."""
    if channel.layer is None:
        return color[..., channel.color]
    if channel.layer.name != name:
        return np.zeros(color.shape[:-1])
    if not channel.layer.grey:
        return color[..., channel.color]
    top = int(np.argmax(channel.layer.color))
    return np.asarray(color[..., top] / channel.layer.color[top])


ALL = tuple(Channel(None, color) for color in range(3))
"""Red, green and blue of all light together."""


def light_tables(scene: Scene, channels: Sequence[Channel]) -> dict[str, Any]:
    """The arrays of a `Marchable` that describe its lights, except for the positions of quads."""
    frame, axes = scene.fields[0].volume.direction, sky_axes(scene)
    shining = [(f.name, f.material.emission) for f in scene.fields]
    shining += [(q.light or q.name, q.material.emission) for q in scene.quads]
    background = np.array([_seen(c, SKY, scene.background) for c in channels], float)
    for light in scene.lights:
        if isinstance(light, Sky) and light.radiance.ndim == 1:
            background += [_seen(c, light.name, light.radiance) for c in channels]
    discs = [light for light in scene.lights if isinstance(light, Distant) and light.irradiance.any()]
    images = [s for s in scene.lights if isinstance(s, Sky) and s.radiance.ndim == 3 and s.radiance.any()]
    # One ray samples light that cosine-distributed rays find badly: lamps, images, and each disc in equal parts.
    lamps = any(q.material.emission.any() for q in scene.quads)
    parts = np.array([float(lamps), float(bool(images)), *np.ones(len(discs))])
    chances = parts / max(parts.sum(), 1.0)
    asked = np.cumsum(chances)
    asked[np.flatnonzero(parts)[-1] if parts.any() else 0 :] = 1.0
    cosine = np.cos(np.radians([d.angle for d in discs]))
    radiance = np.array([[_seen(c, d.name, d.radiance) for c in channels] for d in discs], float)
    harmonics, image = _harmonics(scene, channels, axes), _images(images, channels)
    usual = background
    if len(image) or len(harmonics):
        solid = -np.diff(np.cos(np.linspace(0, np.pi, len(image) + 1))) / 2
        mean = solid @ image.mean(axis=1) if len(image) else 0.0
        usual = background + mean + np.sqrt((harmonics**2).sum(axis=0) / (4 * np.pi))
    return {
        "emission": np.array([[_seen(c, name, color) for c in channels] for name, color in shining], float),
        "background": background,
        "sky_axes": axes @ frame,
        "usual": usual,
        "harmonics": harmonics,
        "disc_axis": np.array([d.direction for d in discs]).reshape(-1, 3) @ frame,
        "disc_cosine": cosine,
        "disc_radiance": radiance.reshape(len(discs), len(channels)),
        "disc_density": chances[2:] / (2 * np.pi * (1 - cosine)),
        "image": image,
        **_asked_pixels(images, float(chances[1])),
        "asked": asked,
    }


def _harmonics(scene: Scene, channels: Sequence[Channel], axes: Floats) -> Floats:
    """Coefficients (B, C) of gradients and `Harmonics`."""
    total = np.zeros(((MOST_DEGREE + 1) ** 2, len(channels)))
    for light in scene.lights:
        if isinstance(light, Sky) and light.radiance.shape == (2, 3):
            own = projected(light, 1, axes)
            total[:4] += np.stack([_seen(c, light.name, own) for c in channels], axis=1)
        elif isinstance(light, Harmonics):
            for number, c in enumerate(channels):
                if c.layer is None:
                    total[: len(light.coefficients), number] += light.coefficients[:, c.color]
                elif c.layer.name.startswith(f"{light.name}."):
                    total[int(c.layer.name.rsplit(".", 1)[1]), number] += 1.0
    used = np.flatnonzero(total.any(axis=1))
    degree = int(np.sqrt(used[-1])) if len(used) else -1
    return np.ascontiguousarray(total[: (degree + 1) ** 2])


def _images(images: list[Sky], channels: Sequence[Channel]) -> Floats:
    """Sum of the images (H, W, C) at the finest of their resolutions."""
    if not images:
        return np.zeros((0, 0, len(channels)))
    shape = np.max([light.radiance.shape[:2] for light in images], axis=0)
    total = np.zeros((*shape, len(channels)))
    for light in images:
        seen = np.stack([_seen(c, light.name, light.radiance) for c in channels], axis=-1)
        total += resampled(seen, *shape)
    return total


def resampled(image: Floats, rows: int, columns: int) -> Floats:
    """An image of the sky (h, w, C) at another resolution: bilinear, the azimuth periodic."""
    h, w, _ = image.shape
    if (h, w) == (rows, columns):
        return image
    v = np.clip((np.arange(rows) + 0.5) * h / rows - 0.5, 0, h - 1)
    u = (np.arange(columns) + 0.5) * w / columns - 0.5
    i, j = np.minimum(v.astype(int), h - 2), np.floor(u).astype(int)
    a, b = (v - i)[:, None, None], (u - j)[None, :, None]
    across = [(1 - b) * image[i + k][:, j % w] + b * image[i + k][:, (j + 1) % w] for k in (0, 1)]
    return np.asarray((1 - a) * across[0] + a * across[1])


def _asked_pixels(images: list[Sky], chance: float) -> dict[str, Floats]:
    """Probabilities with which pixels are sampled: by brightness and solid angle, each image with equal probability.

    The brightness is the mean over the pixel of the interpolated image: half the light of a small sun comes from beyond
    its pixels. A tenth of the samples goes evenly to all directions.
    """
    if not images:
        return {"image_rows": np.zeros(0), "image_columns": np.zeros((0, 0)), "image_density": np.zeros((0, 0))}
    rows, columns = np.max([light.radiance.shape[:2] for light in images], axis=0)
    solid = -np.diff(np.cos(np.linspace(0, np.pi, rows + 1)))[:, None] * 2 * np.pi / columns
    share = np.zeros((rows, columns))
    for light in images:
        bright = _spread(resampled(light.radiance, rows, columns).mean(axis=-1)) * solid
        share += bright / bright.sum() / len(images)
    share = 0.9 * share + 0.1 * np.broadcast_to(solid, share.shape) / (4 * np.pi)
    row = share.sum(axis=1)
    cumulative, inner = np.cumsum(row), np.cumsum(share, axis=1) / row[:, None]
    cumulative[-1], inner[:, -1] = 1.0, 1.0
    return {
        "image_rows": cumulative,
        "image_columns": inner,
        "image_density": np.ascontiguousarray(chance * share / solid),
    }


def _spread(image: Floats) -> Floats:
    """Mean over each pixel (H, W) of the bilinear interpolation of an image, whose azimuth is periodic."""
    rows = np.pad(image, [(1, 1), (0, 0)], mode="edge")
    down = 0.75 * image + 0.125 * (rows[:-2] + rows[2:])
    return np.asarray(0.75 * down + 0.125 * (np.roll(down, 1, axis=1) + np.roll(down, -1, axis=1)))


def in_harmonics(scene: Scene, degree: int) -> Scene:
    """A scene whose distant lights are one light `HARMONICS`: see `Scene.in_harmonics`."""
    if not 0 <= degree <= MOST_DEGREE:
        raise BadInput(f"the degree is {degree}; expected 0 to {MOST_DEGREE}: 2 for soft light, 4 for crisper shadows")
    axes = sky_axes(scene)
    parts = [projected(light, degree, axes) for light in (Sky(SKY, scene.background), *scene.lights)]
    return replace(scene, background=np.zeros(3), lights=(Harmonics(HARMONICS, np.sum(parts, axis=0)),))
