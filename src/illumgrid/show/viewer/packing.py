"""From an `Illumination` to the data of the page: a description in JSON, and its arrays as one run of bytes.

Everything is placed on a *stage*: world axes, the scene's box of size about 1 around its middle, so that single
precision is enough for a graphics card wherever the data lie.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import shown_range
from illumgrid.field.layers import layers_of
from illumgrid.field.scene import Field, Scene
from illumgrid.field.upright import axes_of, up_of
from illumgrid.field.volume import Floats, Lattice, box_corners, histogram
from illumgrid.grid import IlluminationGrid
from illumgrid.grid.channels import Channels, mixed
from illumgrid.grid.nodes import reachable
from illumgrid.grid.walls import WallTexture
from illumgrid.light import Illumination
from illumgrid.show import cuts, trust
from illumgrid.show.camera import HALF_ANGLE, fit_camera, outline_of
from illumgrid.show.caps import channels_on_caps, light_on_caps
from illumgrid.show.looks import displayed
from illumgrid.show.shade import BACKGROUND, CAP_TONE, fades
from illumgrid.show.tints import Tint
from illumgrid.show.viewer import resting, skies
from illumgrid.show.viewer.arrays import (
    HOLE,
    Bytes,
    field_steps,
    pack_layers,
    pack_light,
    pack_values,
    reduced,
    thinned,
)
from illumgrid.show.viewer.texture import STEP, Coming
from illumgrid.tone import WHITE, encode_srgb

MOST_VOXELS = 2**25
"""Voxels of a field that a page holds: 320³, 64 MB of a graphics card's memory at 16 bits."""
MOST_NODES = 2**22
"""Nodes of a grid that a page holds: 160³, 32 MB."""
_BINS = 96


@dataclass(frozen=True)
class Stage:
    """Stage coordinates s of world points: world = middle + size · s."""

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


def _histogram(field: Field) -> dict[str, Any]:
    """Histogram of the voxels over the swept range and a third of its span on either side, as far as there are data."""
    (least, most), (low, high) = field.volume.stored_extremes, field.stored_range
    margin = (high - low) / 3
    low = min(low, max(float(least), low - margin))
    high = max(high, min(float(most), high + margin))
    counts, _ = histogram(field.volume, _BINS, (low, high))
    return {"counts": counts.tolist(), "limits": field.volume.in_units([float(low), float(high)]).tolist()}


def kept_apart(light: Illumination) -> dict[str, float]:
    """Weights of the lights by name, if grids and walls store several lights separately; else none."""
    held = [*(grid.channels for grid in light.grids), *(wall.channels for wall in light.walls)]
    apart = all(channels.mixable and "." in channels.names[-1] for channels in held)
    return {name: float(light.weights.get(name, 1.0)) for name in light.lights} if apart else {}


def _field(
    light: Illumination, number: int, stage: Stage, into: Bytes, notes: list[str], coming: Coming | None
) -> dict[str, Any]:
    field, whole, sky = light.scene.fields[number], light.grids[number], skies.sky_of(light)
    room = skies.room(light) if sky else np.inf
    most = min(MOST_NODES, int(min(1.0, room / (skies.FEWEST + skies.FINE)) * math.prod(whole.spec.shape)))
    volume, grid = reduced(field.volume, MOST_VOXELS), thinned(whole, most)
    sign = field.upward
    swept = field.stored_range if field.isovalue is None else np.array(field.volume.stored_extremes, float)
    ends = sorted(sign * swept)
    steps, base, step, clamped = field_steps(volume, (ends[0], ends[1]), sign)
    _note_reduced(notes, f"The field of {field.name}", "voxels", field.volume.shape, volume.shape)
    _note_reduced(notes, f"The light of {field.name}", "nodes", whole.spec.shape, grid.spec.shape)
    if grid.rows or whole.rows:
        notes.append(f"The light of {field.name}, whose level is held, is that of the middle of the sweep.")
    if clamped:
        notes.append(f"Values of {field.name} far outside the swept range were clamped for this page.")
    spec = coming.specs[number] if coming else grid.spec
    texture = np.diag([*(1 / np.array(spec.shape)), 1.0])
    texture[:3, 3] = 0.5 / np.array(spec.shape)
    material, through = field.material, displayed(light.scene).fields[number].material.transmission
    shown_albedo = displayed(light.scene).fields[number].material.albedo / max(1 - through, 1e-9)
    albedo = material.albedo
    error = np.where(np.isfinite(grid.bar), trust.relative(whole, grid.bar), HOLE)
    scale = light.exposure / np.pi
    shown = pack_light(_mix(grid.channels, grid.light) * scale, error, into)
    if coming:
        shown |= {"shape": list(spec.shape), "every": STEP}
    shown |= {"usual": _usual(light, grid), "near": float(spec.spacing.max() / stage.size)}
    if kept_apart(light):
        layers = layers_of(light.scene)
        shown["layers"] = pack_layers(grid.light * scale, grid.channels, layers, shown["channels"], into)
    if sky:
        lit = np.zeros(grid.spec.shape, bool)
        lit.flat[reachable(field, grid.spec)] = True
        held = skies.answers(light, sky, (grid.light.transpose(2, 1, 0, 3) * scale)[lit.T], grid.channels)
        kept = skies.fitting(room * math.prod(whole.spec.shape) / grid.support.size, sky)
        shown["mask"] = into.add(np.packbits(lit.T.ravel(), bitorder="little").tobytes())
        shown["sky"], lost = skies.pack_sky(held, kept, into)
        _note_lost(notes, field.name, kept, len(sky.coefficients), lost)
    return {
        "name": field.name,
        "range": field.range.tolist(),
        "sweep": field.sweep.tolist(),
        "upward": sign,
        "albedo": shown_albedo.tolist(),  # of fields that are not translucent
        "through": through,
        "rough": material.roughness,
        "window": [(sign * float(x) - base) / step for x in field.volume.to_stored(cuts.window(field))],
        "swatch": _css(WHITE * albedo / albedo.max(initial=1e-9)),
        "histogram": _histogram(field),
        "values": pack_values(steps, into)
        | {"base": base * field.volume.slope + sign * field.volume.intercept, "step": step * field.volume.slope},
        "light": shown,
        "caps": _caps(light, number),
        "toIndex": stage.to_index(volume).T.ravel().tolist(),
        "toTexture": (texture @ stage.to_index(spec)).T.ravel().tolist(),
    }


def _caps(light: Illumination, number: int) -> dict[str, Any]:
    """Exposed light of the faces of a field's box, -1 if unknown, and the contribution of each light or sky."""
    scale, sky, apart = light.exposure / np.pi, skies.sky_of(light), kept_apart(light)
    found, channels = channels_on_caps(light, number)
    shown = np.nan_to_num(light_on_caps(light, number) * np.float32(scale), nan=-1.0)
    described: dict[str, Any] = {"shown": shown.tolist(), "layers": [], "sky": None, "rest": None}
    if apart:
        only = [{name: float(name == one) for name in apart} for one in apart]
        mixes = [np.array(mixed(channels, layers_of(light.scene), weights).mix) for weights in only]
        described["layers"] = [(scale * found @ mix).tolist() for mix in mixes]
    if sky:
        held = skies.answers(light, sky, (scale * found).astype(np.float32), channels)
        described |= {"sky": held.light[:, 0].tolist(), "rest": held.rest.tolist()}
    return described


def _note_reduced(
    notes: list[str], what: str, points: str, before: tuple[int, int, int], after: tuple[int, int, int]
) -> None:
    if before != after:
        sizes = " to ".join("\u2009×\u2009".join(map(str, shape)) for shape in (before, after))
        notes.append(f"{what} was reduced for this page from {sizes} {points}.")


def _mix(channels: Channels, light: NDArray[np.float32]) -> NDArray[np.float32]:
    """The shown mix of light (..., C), clamped only after interpolation, as in `IlluminationGrid.lookup`."""
    return channels.shown(light) if channels.own else np.asarray(light @ np.array(channels.mix, np.float32))


def _usual(light: Illumination, held: IlluminationGrid | WallTexture) -> list[float]:
    """Exposed mean light of nodes with light of their own; for lights stored separately, of each at weight 1."""
    apart, lit = kept_apart(light), held.light[held.support > 0]
    mixes = [{name: float(name == one) for name in apart} for one in apart]
    shown = [mixed(held.channels, layers_of(light.scene), weights) for weights in mixes] or [held.channels]
    found = [channels.shown(lit).mean(dtype=float) if len(lit) else 0.0 for channels in shown]
    return [light.exposure / np.pi * float(mean) for mean in found]


def _note_lost(notes: list[str], name: str, kept: int, of: int, lost: float) -> None:
    if lost:
        notes.append(
            f"Under another sky the light of {name} is that of {kept} components for {of} basis functions of the sky: "
            f"{lost:.1%} of it is left out, in the mean over skies."
        )


def _css(linear: Floats) -> str:
    return "#" + "".join(f"{int(c):02x}" for c in encode_srgb(linear))


def _beside(walls: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Textures (K, nv, nu, C) of walls, joined side by side into one (u, v, sweep, C)."""
    high = max(wall.shape[1] for wall in walls)
    padded = [np.pad(wall, [(0, 0), (0, high - wall.shape[1]), (0, 0), (0, 0)]) for wall in walls]
    return np.concatenate(padded, axis=2).transpose(2, 1, 0, 3)


def _walls(light: Illumination, stage: Stage, into: Bytes) -> tuple[list[dict[str, Any]], dict[str, Any] | None]:
    """The quads, and the light of all of them side by side in one texture (u, v, sweep)."""
    quads = light.scene.quads
    if not quads:
        return [], None
    scale, offset, described = light.exposure / np.pi, 0, []
    for number, quad in enumerate(quads):
        nu, nv = quad.texels
        material = quad.material
        described.append(
            {
                "corner": stage.place(quad.corner).tolist(),
                "edgeU": (quad.edge_u / stage.size).tolist(),
                "edgeV": (quad.edge_v / stage.size).tolist(),
                "normal": quad.normal.tolist(),
                "texels": [nu, nv],
                "near": max(math.hypot(*quad.edge_u) / nu, math.hypot(*quad.edge_v) / nv) / stage.size,
                "usual": _usual(light, light.walls[number]),
                "fades": fades(light.scene, number),
                "offset": [offset, 0],
                "albedo": material.albedo.tolist(),
                "emission": (material.emission * light.exposure).tolist(),
                "localColor": np.maximum(material.albedo, material.emission.clip(0, 1)).tolist(),
            }
        )
        offset += nu
    shown = _beside([_mix(wall.channels, wall.light) for wall in light.walls]) * scale
    own = _beside([(wall.support > 0)[..., None].astype(np.float32) for wall in light.walls])[..., 0]
    atlas = pack_light(shown, np.where(own > 0, 0.0, HOLE), into)
    if kept_apart(light):
        layers, channels = _beside([wall.light for wall in light.walls]) * scale, light.walls[0].channels
        atlas["layers"] = pack_layers(layers, channels, layers_of(light.scene), atlas["channels"], into)
    if sky := skies.sky_of(light):
        side = _beside([wall.light for wall in light.walls]).transpose(2, 1, 0, 3) * scale
        held = skies.answers(light, sky, side, light.walls[0].channels)
        atlas["sky"], _ = skies.pack_sky(held, skies.fitting(skies.room(light), sky), into)
    return described, atlas


def opening(scene: Scene, up: str | None = None) -> dict[str, Any]:
    """The view of the still picture at the middle of the sweep, and the hull that it must contain."""
    from scipy.spatial import ConvexHull, QhullError

    stage = Stage.of(scene)
    row = scene.levels(0.5)[0]
    right, front, upright = axes_of(scene.fields[0].volume.direction, up_of(scene) if up is None else up)
    forward = fit_camera(scene, row, 1.0, up=up).forward
    points = stage.place(outline_of(scene, row))
    try:
        points = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # flat, or too few points: its box is a hull, too
        points = np.array(list(np.ndindex(2, 2, 2))) * np.ptp(points, axis=0) + points.min(axis=0)
    return {
        "azimuth": float(np.arctan2(-forward @ right, -forward @ front)),
        "elevation": float(np.arcsin(np.clip(-forward @ upright, -1, 1))),
        "outline": np.round(points, 4).tolist(),
    }


def _between(colors: Floats, steps: int = 13) -> Floats:
    """Colours (steps, 3), evenly between given ones: a style sheet interpolates in sRGB, the shader in linear light."""
    at = np.linspace(0, len(colors) - 1, steps)
    return np.stack([np.interp(at, np.arange(len(colors)), channel) for channel in colors.T], axis=1)


def _tint(tint: Tint, stage: Stage, into: Bytes) -> dict[str, Any]:
    """A second quantity in 256 steps, and its colours."""
    volume = reduced(tint.volume, MOST_NODES)
    low, high = tint.ends
    share = np.clip((volume.values.astype(float) - low) / (high - low), 0.0, 1.0)
    texture = np.diag([*(1 / np.array(volume.shape)), 1.0])
    texture[:3, 3] = 0.5 / np.array(volume.shape)
    return {
        "name": tint.name,
        "ends": [low, high],
        "colors": [f"#{bytes(color).hex()}" for color in tint.table[::15]],
        "map": into.add(tint.table.tobytes()),
        "values": pack_values(np.round(255 * np.nan_to_num(share)).astype(np.uint8), into),
        "toTexture": (texture @ stage.to_index(volume)).T.ravel().tolist(),
    }


def packed(
    light: Illumination, up: str | None = None, tint: Tint | None = None, coming: Coming | None = None
) -> tuple[dict[str, Any], bytes]:
    """Description of a scene for the page, and the arrays that it points into; see `illumgrid.show.viewer.page`."""
    scene, into = light.scene, Bytes()
    stage, notes = Stage.of(scene), list[str]()
    fields = [_field(light, number, stage, into, notes, coming) for number in range(len(scene.fields))]
    walls, atlas = _walls(light, stage, into)
    lead = next((k for k, field in enumerate(scene.fields) if field.isovalue is None), 0)
    ranges = shown_range(scene.fields[lead].range, 6)
    box = np.concatenate([stage.place(box_corners(field.volume)) for field in scene.fields])
    several = "all fields share one sweep" if len(fields) > 1 else f"light for isovalues {ranges}"
    described = {
        "title": ", ".join(f.name for f in scene.fields),
        "subtitle": f"Global light from an illumination grid; {several}.",
        "notes": [*notes, *(f"Error bars: {doubt}." for doubt in (() if coming else trust.doubts(light)))],
        "live": coming.stamp if coming else 0,
        "axes": [
            axis.tolist() for axis in axes_of(scene.fields[0].volume.direction, up_of(scene) if up is None else up)
        ],
        "tangent": HALF_ANGLE,
        "opening": (coming and coming.opening) or opening(scene, up),
        "background": BACKGROUND,
        "capTone": CAP_TONE,
        "white": WHITE,
        "trust": {
            "ends": [trust.LOW, trust.HIGH],
            "scale": trust.SCALE.tolist(),
            "hatch": trust.HATCH.tolist(),
            "colors": [_css(color) for color in _between(trust.SCALE.astype(float))],
        },
        "sky": skies.described(light),
        "resting": resting.described(light, list(kept_apart(light)), into),
        "lights": [{"name": name, "weight": weight} for name, weight in kept_apart(light).items()],
        "fields": fields,
        "lead": lead,
        "clip": {
            "low": box.min(axis=0).tolist(),
            "high": box.max(axis=0).tolist(),
            "middle": stage.middle.tolist(),
            "size": stage.size,
        },
        "tint": None if tint is None else _tint(tint, stage, into),
        "walls": walls,
        "atlas": atlas,
    }
    return described, b"".join(into.parts)
