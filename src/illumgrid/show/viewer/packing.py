"""From an `Illumination` to what the page draws: a description in JSON, and its arrays as one run of bytes.

Everything is placed on a *stage*: world axes, the scene's box of size about 1 around its middle, so that single
precision is enough for a graphics card wherever the data lie.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.levelset import turned
from illumgrid.field.scene import Field, Scene, upright
from illumgrid.field.volume import Floats, Lattice, Volume, box_corners, index_to_world
from illumgrid.grid import GridSpec, IlluminationGrid
from illumgrid.show.camera import HALF_ANGLE, fit_camera, outline_of
from illumgrid.show.shade import BACKGROUND, CAP_TONE
from illumgrid.tone import WHITE, encode_srgb

if TYPE_CHECKING:
    from illumgrid.light import Illumination

MOST_VOXELS = 2**25
"""Voxels of a field that a page holds: 320³, 64 MB of a graphics card's memory at 16 bits."""
MOST_NODES = 2**22
"""Nodes of a grid that a page holds: 160³, 32 MB."""
_STEPS = 65535
_FINE = 4096  # steps that the swept range must span: else values far outside it are clamped
_BINS = 96
_HOLE = -1.0
_SURE_TO_NOT = np.array([[0, 0.0144, 0.0742], [0.0742, 0.0865, 0.153], [0.376, 0.332, 0.174], [1, 0.823, 0.0612]])
"""Linear colours of the error, after cividis (Nunez et al. 2018): read alike with and without colour vision."""


@dataclass(frozen=True)
class Stage:
    """Stage coordinates s stand for world points middle + size s."""

    middle: Floats
    size: float

    @classmethod
    def of(cls, scene: Scene) -> "Stage":
        """The stage that holds the fields."""
        world = np.concatenate([box_corners(f.volume) for f in scene.fields])
        low, high = world.min(axis=0), world.max(axis=0)
        return cls((low + high) / 2, float((high - low).max()))

    def place(self, world: Floats) -> Floats:
        """Stage coordinates (..., 3) of world points."""
        return (np.asarray(world, float) - self.middle) / self.size

    def to_index(self, lattice: Lattice) -> Floats:
        """Affine map (4, 4) from the stage to fractional indices of a lattice."""
        turn = lattice.direction.T / lattice.spacing[:, None]
        result = np.eye(4)
        result[:3, :3] = turn * self.size
        result[:3, 3] = turn @ (self.middle - lattice.origin)
        return result


class Bytes:
    """Arrays, one after the other."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.length = 0

    def add(self, part: bytes) -> int:
        """Append, and say where it begins."""
        self.parts.append(part)
        self.length += len(part)
        return self.length - len(part)


def reduced(volume: Volume, most: int) -> Volume:
    """Means over blocks of voxels, the same number along each axis, until at most `most` remain."""
    factor = 1
    while np.prod([-(-n // factor) for n in volume.shape]) > most:
        factor += 1
    if factor == 1:
        return volume
    padded = np.pad(volume.values, [(0, -n % factor) for n in volume.shape], mode="edge")
    split = padded.reshape([k for n in padded.shape for k in (n // factor, factor)])
    origin = index_to_world(volume, np.full((1, 3), (factor - 1) / 2))[0]
    return Volume(split.mean(axis=(1, 3, 5)), origin, volume.spacing * factor, volume.direction)


def _thinned(grid: IlluminationGrid) -> IlluminationGrid:
    """Every second, third... node, until a page holds them: a node is never a mean across a surface."""
    factor = 1
    while np.prod([-(-n // factor) for n in grid.spec.shape]) > MOST_NODES:
        factor += 1
    if factor == 1 or min(grid.spec.shape) <= factor:
        return grid
    some = (slice(None, None, factor),) * 3
    spec = GridSpec(grid.support[some].shape, grid.spec.origin, grid.spec.spacing * factor, grid.spec.direction)
    return IlluminationGrid(spec, grid.values[some], grid.error[some], grid.support[some])


def field_steps(values: NDArray[np.float32], limits: tuple[float, float]) -> tuple[NDArray[Any], float, float, bool]:
    """Values as whole steps of 8 or 16 bits: (steps, base, step, whether any was clamped); value = base + step · steps.

    Whole numbers that fit stay exact. Others get 65535 steps over all values, or over the swept `limits` and eight
    times their span on either side where they would get too few of them.
    """
    low, high = float(values.min()), float(values.max())
    if high - low <= _STEPS and max(abs(low), abs(high)) < 2**24 and (values == np.round(values)).all():
        return (values - low).astype(np.uint8 if high - low < 256 else np.uint16), low, 1.0, False
    clamped = (limits[1] - limits[0]) * _STEPS < _FINE * (high - low)
    if clamped:
        span = limits[1] - limits[0]
        low, high = max(low, limits[0] - 8 * span), min(high, limits[1] + 8 * span)
    step = (high - low) / _STEPS or 1.0
    steps = np.clip(np.round((values.astype(float) - low) / step), 0, _STEPS).astype(np.uint16)
    return steps, low, step, clamped


def _planes(words: NDArray[np.uint16]) -> bytes:
    """All low bytes, then all high bytes: like lies beside like, and packs better."""
    return (words & 0xFF).astype(np.uint8).tobytes() + (words >> 8).astype(np.uint8).tobytes()


def _pack_values(steps: NDArray[Any], into: Bytes) -> dict[str, Any]:
    x_fastest = np.ascontiguousarray(steps.transpose(2, 1, 0))
    x_fastest[:, :, 1:] -= x_fastest[:, :, :-1].copy()  # wraps around, and is undone by adding up
    data = x_fastest.tobytes() if steps.dtype == np.uint8 else _planes(x_fastest.ravel())
    return {"shape": list(steps.shape), "bytes": steps.dtype.itemsize, "offset": into.add(data)}


def _pack_light(rgb: NDArray[np.floating], error: NDArray[np.floating], into: Bytes) -> dict[str, Any]:
    """Light (nx, ny, nz, 3) and its error (nx, ny, nz) as half floats, x fastest."""
    texels = np.concatenate([rgb, error[..., None]], axis=3).transpose(3, 2, 1, 0)
    half = np.clip(texels, -65504, 65504).astype(np.float16).view(np.uint16).reshape(4, -1)
    half[1:3] -= half[0]  # white light packs to a third
    return {"shape": list(rgb.shape[:3]), "offset": into.add(b"".join(_planes(channel) for channel in half))}


def _histogram(field: Field) -> dict[str, Any]:
    """Voxels over the swept range and a third of its span on either side, as far as there are data."""
    values, (low, high) = field.volume.values, field.range
    margin = (high - low) / 3
    low = min(low, max(float(values.min()), low - margin))
    high = max(high, min(float(values.max()), high + margin))
    counts, _ = np.histogram(values, _BINS, (low, high))
    return {"counts": counts.tolist(), "limits": [float(low), float(high)]}


def _field(light: "Illumination", number: int, stage: Stage, into: Bytes, notes: list[str]) -> dict[str, Any]:
    field, whole, grid = light.scene.fields[number], light.grids[number], _thinned(light.grids[number])
    volume = reduced(field.volume, MOST_VOXELS)
    sign = field.upward
    ends = sorted(sign * field.range)
    steps, base, step, clamped = field_steps(turned(volume, field.inside), (ends[0], ends[1]))
    for what, before, after in (
        ("field", field.volume.shape, volume.shape),
        ("light", whole.spec.shape, grid.spec.shape),
    ):
        if before != after:
            sizes = " to ".join("\u2009×\u2009".join(map(str, shape)) for shape in (before, after))
            notes.append(
                f"The {what} of {field.name} was reduced for this page from {sizes} "
                f"{'voxels' if what == 'field' else 'nodes'}."
            )
    if clamped:
        notes.append(f"Values of {field.name} far outside the swept range were clamped for this page.")
    shown = light.exposure / np.pi
    texture = np.diag([*(1 / np.array(grid.spec.shape)), 1.0])
    texture[:3, 3] = 0.5 / np.array(grid.spec.shape)
    albedo = field.material.albedo
    return {
        "name": field.name,
        "range": field.range.tolist(),
        "upward": sign,
        "albedo": albedo.tolist(),
        "swatch": _css(WHITE * albedo / albedo.max(initial=1e-9)),
        "histogram": _histogram(field),
        "values": _pack_values(steps, into) | {"base": base, "step": step},
        "light": _pack_light(grid.values * shown, np.where(np.isfinite(grid.bar), grid.bar * shown, _HOLE), into),
        "toIndex": stage.to_index(volume).T.ravel().tolist(),
        "toTexture": (texture @ stage.to_index(grid.spec)).T.ravel().tolist(),
    }


def _css(linear: Floats) -> str:
    return "#" + "".join(f"{int(c):02x}" for c in encode_srgb(linear))


def _walls(light: "Illumination", stage: Stage, into: Bytes) -> tuple[list[dict[str, Any]], dict[str, Any] | None]:
    """The quads, and the light of all of them side by side in one texture (u, v, sweep)."""
    quads = light.scene.quads
    if not quads:
        return [], None
    rows, wide, high = len(light.levels.table), sum(q.texels[0] for q in quads), max(q.texels[1] for q in quads)
    atlas, offset, described = np.zeros((wide, high, rows, 3), np.float32), 0, []
    for quad, wall in zip(quads, light.walls):
        nu, nv = quad.texels
        atlas[offset : offset + nu, :nv] = wall.values.transpose(2, 1, 0, 3) * (light.exposure / np.pi)
        material = quad.material
        described.append(
            {
                "corner": stage.place(quad.corner).tolist(),
                "edgeU": (quad.edge_u / stage.size).tolist(),
                "edgeV": (quad.edge_v / stage.size).tolist(),
                "normal": quad.normal.tolist(),
                "texels": [nu, nv],
                "offset": [offset, 0],
                "albedo": material.albedo.tolist(),
                "emission": (material.emission * light.exposure).tolist(),
                "localColor": np.maximum(material.albedo, material.emission.clip(0, 1)).tolist(),
            }
        )
        offset += nu
    return described, _pack_light(atlas, np.zeros(atlas.shape[:3]), into)


def _opening(scene: Scene, stage: Stage) -> dict[str, Any]:
    """The view of the still picture at the middle of the sweep, and the hull that it must hold."""
    from scipy.spatial import ConvexHull, QhullError

    row = scene.levels(0.5)[0]
    right, front, up = upright(scene.fields[0].volume.direction)
    forward = fit_camera(scene, row, 1.0).forward
    points = stage.place(outline_of(scene, row))
    try:
        points = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # flat, or too few: its box is a hull too
        points = np.array(list(np.ndindex(2, 2, 2))) * np.ptp(points, axis=0) + points.min(axis=0)
    return {
        "azimuth": float(np.arctan2(-forward @ right, -forward @ front)),
        "elevation": float(np.arcsin(np.clip(-forward @ up, -1, 1))),
        "outline": np.round(points, 4).tolist(),
    }


def _doubt(light: "Illumination") -> float:
    """The relative error that gets the last colour: what 95 % of the nodes stay below, rounded up."""
    relative = []
    for grid in light.grids:
        known = np.isfinite(grid.bar) & (grid.values.mean(axis=3) > 0)
        relative.append(grid.bar[known] / grid.values[known].mean(axis=1))
    joined = np.concatenate(relative)
    worst = float(np.quantile(joined, 0.95)) if len(joined) else 0.0
    return float(np.clip(np.ceil(worst * 50) / 50, 0.02, 1.0))


def _between(colors: Floats, steps: int = 13) -> Floats:
    """Colours (steps, 3), evenly between those given: a style sheet mixes in sRGB, the shader in linear light."""
    at = np.linspace(0, len(colors) - 1, steps)
    return np.stack([np.interp(at, np.arange(len(colors)), channel) for channel in colors.T], axis=1)


def packed(light: "Illumination") -> tuple[dict[str, Any], bytes]:
    """Description of a scene for the page, and the arrays that it points into."""
    scene, into = light.scene, Bytes()
    stage, notes = Stage.of(scene), list[str]()
    fields = [_field(light, number, stage, into, notes) for number in range(len(scene.fields))]
    walls, atlas = _walls(light, stage, into)
    ranges = " to ".join(f"{end:g}" for end in scene.fields[0].range)
    several = "all fields share one sweep" if len(fields) > 1 else f"light for isovalues {ranges}"
    described = {
        "title": ", ".join(f.name for f in scene.fields),
        "subtitle": f"Global light from an illumination grid; {several}.",
        "notes": notes,
        "axes": [axis.tolist() for axis in upright(scene.fields[0].volume.direction)],
        "tangent": HALF_ANGLE,
        "opening": _opening(scene, stage),
        "background": BACKGROUND,
        "capTone": CAP_TONE,
        "white": WHITE,
        "trust": _doubt(light),
        "trustScale": _SURE_TO_NOT.tolist(),
        "trustColors": [_css(color) for color in _between(_SURE_TO_NOT)],
        "fields": fields,
        "walls": walls,
        "atlas": atlas,
    }
    return described, b"".join(into.parts)
