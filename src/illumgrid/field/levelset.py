"""Level sets, as meshes and as bricks for marching."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field import cubes
from illumgrid.field.bricks import Bricks, lay_bricks
from illumgrid.field.layers import ALL, Channel, light_tables
from illumgrid.field.scene import Scene
from illumgrid.field.storing import NATIVE
from illumgrid.field.volume import UPWARD, Floats, Side, Volume, index_to_world, slabs

if TYPE_CHECKING:
    import trimesh


def off_the_data(volume: Volume, isovalue: float, inside: Side) -> float:
    """Shift a stored isovalue that is also a data value by one ulp, to the side that keeps the solid.

    Extraction exactly at data values would create duplicate faces and holes.
    """
    level = np.float32(isovalue)
    if not any((volume.stored[slab] == level).any() for slab in slabs(volume.shape)):
        return float(isovalue)
    return float(np.nextafter(level, np.float32(-np.inf * UPWARD[inside])))


def isosurface(volume: Volume, isovalue: float, inside: Side = "above", capped: bool = False) -> "trimesh.Trimesh":
    """Mesh of the level set {h = isovalue}.

    Parameters
    ----------
    volume : Volume
    isovalue : float
    inside : {"above", "below"}
        Which side is solid; the faces point away from it.
    capped : bool
        Close the solid where it meets the border of the volume: the mesh is then watertight.

    Returns
    -------
    trimesh.Trimesh
        World units, normals pointing outside; empty if no voxel edge crosses the isovalue.

    References
    ----------
    .. [1] T. Lewiner, H. Lopes, A. W. Vieira, G. Tavares, "Efficient implementation of marching cubes' cases with
           topological guarantees", J. Graphics Tools 8(2), 2003 (scikit-image's ``marching_cubes``).
    """
    import trimesh

    if not np.isfinite(isovalue):
        raise BadInput(f"the isovalue is {isovalue}; expected a finite number")
    if inside not in UPWARD:
        raise BadInput(f"inside is {inside!r}; expected 'above' or 'below'")
    index, faces = extract(volume, isovalue, inside, capped)
    if np.linalg.det(volume.direction) < 0:
        faces = faces[:, ::-1]
    return trimesh.Trimesh(index_to_world(volume, index), faces, process=False)


def extract(volume: Volume, isovalue: float, inside: Side, capped: bool) -> tuple[Floats, NDArray[np.int64]]:
    """Vertices (k, 3) in index coordinates and faces (m, 3) of a level set: see `isosurface`.

    Faces are counterclockwise as seen from outside, with right-handed index axes.
    """
    level = off_the_data(volume, float(volume.to_stored(isovalue)), inside)
    low, high = float(volume.stored.min()), float(volume.stored.max())
    beyond = None
    if capped:
        spread = max(float(np.float32(high) - np.float32(low)), abs(level), 1e-30)
        beyond = float(np.float32(min(low, level) - spread if inside == "above" else max(high, level) + spread))
        low, high = min(low, beyond), max(high, beyond)
    if not low < level < high:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    # scikit-image adds 2e-16 to every difference, which would dominate tiny fields: scale by a power of two.
    exponent = int(np.frexp(high - low)[1])
    # Its faces wind by the left hand: "ascent" orients them, by the right hand, away from higher values.
    winding: cubes.Winding = "ascent" if inside == "above" else "descent"
    index, faces = cubes.march(_scaled(volume.stored, -exponent, beyond), float(np.ldexp(level, -exponent)), winding)
    return np.clip(index - (1.0 if capped else 0.0), 0.0, np.array(volume.shape) - 1.0), faces


def _scaled(values: NDArray[Any], exponent: int, beyond: float | None) -> NDArray[np.float32]:
    """Values times a power of two, in one new array of single precision; with a border of `beyond` if that is given."""
    rim = 0 if beyond is None else 1
    scaled = np.empty(tuple(n + 2 * rim for n in values.shape), np.float32)
    if beyond is not None:
        scaled[[0, -1]] = scaled[:, [0, -1]] = scaled[:, :, [0, -1]] = np.ldexp(np.float32(beyond), exponent)
    within = scaled[tuple(slice(rim, rim + n) for n in values.shape)]
    for slab in slabs(values.shape):
        np.ldexp(values[slab].astype(np.float32, copy=False), exponent, out=within[slab])
    return scaled


class Marchable(NamedTuple):
    """All fields of a scene as flat arrays for marching by a compiled kernel, in the frame of the scene.

    The solid of every field is {sign v >= level}: for `inside` "below" the sign is -1, and levels change theirs too.
    The bricks serve every isovalue. A field that transmits has a second entry, after all F fields, whose solid is the
    outside: rays within its shell march that entry, with minus the level.
    """

    values: NDArray[Any]  # of one of the types `field.volume.NATIVE`: all volumes one after the other, C order
    twin: NDArray[np.int64]  # (F,) entry of the outside of a field that transmits; -1 for others
    transmission: Floats  # (F,), or (0,) if no field transmits
    # From here to the bricks there are E entries of fields: F, or more if some transmit.
    sign: Floats  # (E,)
    start: NDArray[np.int64]  # (F,) offset of each field
    shape: NDArray[np.int64]  # (F, 3) voxels
    origin: Floats  # (F, 3) frame position of voxel 0
    spacing: Floats  # (F, 3)
    steps: NDArray[np.float32]  # (F, RANKS) as in `illumgrid.field.bricks`
    bricks: NDArray[np.uint8]  # 128 bytes per brick, all fields concatenated
    brick_start: NDArray[np.int64]  # (F,) number of bricks before
    brick_shape: NDArray[np.int64]  # (F, 3)
    shift: NDArray[np.int64]  # (E,) a brick has 2^shift cells along each side
    albedo: Floats  # (F + Q, 3) fields, then quads: share of the light not transmitted that is reflected
    emission: Floats  # (F + Q, 3)
    background: Floats  # (3,) constant radiance from all directions outside
    quad_corner: Floats  # (Q, 3) in the frame, as all that follows
    quad_edges: Floats  # (Q, 2, 3)
    quad_duals: Floats  # (Q, 2, 3): dot with a point from the corner gives its shares (0 to 1) along the edges
    quad_normal: Floats  # (Q, 3) towards the front
    quad_size: Floats  # (Q,) length of its edges, the scale of rounding errors
    lamps: NDArray[np.int64]  # (L,) numbers of the quads that emit
    lamp_share: Floats  # (L,) cumulative probability of choosing a lamp, proportional to its power
    lamp_density: Floats  # (Q,) probability density per area of choosing a point of the quad; 0 if it does not emit
    lamplight: Floats  # (3,) radiance of all lamps spread over a box around the scene, of all discs over the sky
    # Other distant light, in C channels; directions in the frame, or along the axes of the sky.
    sky_axes: Floats  # (3, 3) rows right, back, up in the frame
    usual: Floats  # (C,) mean radiance of the sky without discs
    harmonics: Floats  # (B, C) coefficients of the smooth skies; B is 0, or that of a whole degree
    disc_axis: Floats  # (D, 3) frame directions to the middles
    disc_cosine: Floats  # (D,) cosine of the half-angle
    disc_radiance: Floats  # (D, C)
    disc_density: Floats  # (D,) probability density per solid angle of sampling its directions
    image: Floats  # (H, W, C) sum of the images; (0, 0, C) if there is none
    image_rows: Floats  # (H,) cumulative probability of a row
    image_columns: Floats  # (H, W) cumulative probability of a pixel in its row
    image_density: Floats  # (H, W) probability density per solid angle, as for discs
    asked: Floats  # (2 + D,) cumulative probability of sampling lamps, the image, each disc


def _together(volumes: Sequence[Volume]) -> tuple[NDArray[Any], NDArray[np.int64]]:
    """The values of volumes as one flat array, and where each begins; a single volume is not copied."""
    parts = list({id(volume.stored): volume.stored.reshape(-1) for volume in volumes}.items())
    ends = np.cumsum([0, *(len(values) for _, values in parts)], dtype=np.int64)
    first = {key: start for (key, _), start in zip(parts, ends)}
    kind = np.result_type(*(values for _, values in parts))
    together = parts[0][1].view()
    if len(parts) > 1:  # two types that no small type holds: all are promoted
        together = np.concatenate([v for _, v in parts], dtype=kind if kind in NATIVE else np.float32)
    together.setflags(write=False)  # as for a single volume; otherwise Numba compiles all kernels for a second type
    return together, np.array([first[id(volume.stored)] for volume in volumes])


_LAID: WeakKeyDictionary[Volume, dict[float, Bricks]] = WeakKeyDictionary()


def _bricks_of(volume: Volume, sign: float) -> Bricks:
    """Bricks of a volume, laid once for its lifetime: bake, measurement of the error and pictures share them."""
    laid = _LAID.setdefault(volume, {})
    if sign not in laid:
        laid[sign] = lay_bricks(volume.stored, sign)
    return laid[sign]


def marchable(scene: Scene, channels: Sequence[Channel] = ALL) -> Marchable:
    """Lay out a scene for marching. This takes time, so keep the result. A single volume is not copied.

    Albedos and lights have a column for each of `channels`, by default red, green and blue of all light together.
    """
    films = [f for f in scene.fields if f.material.transmission > 0]
    entries = [(f.volume, f.upward) for f in scene.fields] + [(f.volume, -f.upward) for f in films]
    values, start = _together([volume for volume, _ in entries])
    bricks = [_bricks_of(volume, sign) for volume, sign in entries]
    records = [b.records.reshape(-1) for b in bricks]
    materials = [f.material for f in scene.fields] + [q.material for q in scene.quads]
    through = np.array([f.material.transmission for f in scene.fields])
    kept = np.array([1.0 - m.transmission for m in materials])[:, None]
    albedo = np.array([m.albedo for m in materials])
    colors, tables = [channel.color for channel in channels], light_tables(scene, channels)
    return Marchable(
        values=values,
        twin=np.where(through > 0, len(through) - 1 + np.cumsum(through > 0), -1),
        transmission=through if films else np.zeros(0),
        sign=np.array([sign for _, sign in entries]),
        start=start,
        shape=np.array([volume.shape for volume, _ in entries], dtype=np.int64),
        origin=scene.to_frame([volume.origin for volume, _ in entries]),
        spacing=np.array([volume.spacing for volume, _ in entries]),
        steps=np.array([b.steps for b in bricks]),
        bricks=records[0] if len(records) == 1 else np.concatenate(records),
        brick_start=np.cumsum([0, *(len(b.records) for b in bricks)], dtype=np.int64)[:-1],
        brick_shape=np.array([b.shape for b in bricks], dtype=np.int64),
        shift=np.array([b.shift for b in bricks], dtype=np.int64),
        albedo=np.ascontiguousarray(np.divide(albedo, kept, out=np.zeros_like(albedo), where=kept > 0)[:, colors]),
        **_quads_in_frame(scene, tables),
        **tables,
    )


def _quads_in_frame(scene: Scene, lights: dict[str, Floats]) -> dict[str, NDArray[Any]]:
    """The quad and lamp arrays of a `Marchable`."""
    axes, count = scene.fields[0].volume.direction, len(scene.quads)
    corner = scene.to_frame(np.array([q.corner for q in scene.quads]).reshape(count, 3))
    # The front is defined in the world: with mirrored axes it is not the side of edge_u x edge_v in the frame.
    normal = np.array([q.normal for q in scene.quads]).reshape(count, 3) @ axes
    edges = np.array([(q.edge_u, q.edge_v) for q in scene.quads]).reshape(count, 2, 3) @ axes
    across = np.cross(edges[:, ::-1], normal[:, None])
    area = np.array([q.area for q in scene.quads])
    power = np.array([q.material.emission.mean() * q.area for q in scene.quads]).reshape(count)
    lamps = np.flatnonzero(power > 0)
    chance = power / power.sum() * lights["asked"][0] if len(lamps) else power
    boxes = [index_to_world(f.volume, [np.zeros(3), np.array(f.volume.shape) - 1.0]) for f in scene.fields]
    ends = [scene.to_frame(np.concatenate(boxes))]
    ends += [corner + one + other for one in (0, edges[:, 0]) for other in (0, edges[:, 1])]
    a, b, c = np.ptp(np.concatenate(ends), axis=0)
    emission = lights["emission"][len(scene.fields) :]
    flux = sum((color * q.area for color, q in zip(emission, scene.quads)), np.zeros(emission.shape[1]))
    discs = 0.5 * (1 - lights["disc_cosine"]) @ lights["disc_radiance"]
    return {
        "quad_corner": corner,
        "quad_edges": edges,
        "quad_duals": across / (edges * across).sum(axis=2, keepdims=True),
        "quad_normal": normal,
        "quad_size": np.abs(edges).sum(axis=(1, 2)),
        "lamps": lamps,
        "lamp_share": np.cumsum(chance[lamps]),
        "lamp_density": chance / area if count else power,
        "lamplight": flux / (2 * (a * b + b * c + c * a)) + discs,
    }


def turned_levels(scene: Scene, levels: Floats) -> Floats:
    """Isovalues (..., F) for comparison with the values of a `Marchable`: as stored, times the sign `upward`."""
    sign = np.array([field.upward for field in scene.fields])
    stored = np.stack([f.volume.to_stored(levels[..., k]) for k, f in enumerate(scene.fields)], axis=-1)
    return np.asarray(stored * sign, np.float64)
