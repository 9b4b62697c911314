"""Clip planes: parts beyond them are left out of a picture, and the cut shows the data in grey.

Display only: the light is that of the whole solid. Walls stay whole.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from illumgrid.constants import MISS, QUAD
from illumgrid.errors import BadInput, shown_range, tell
from illumgrid.field.scene import Field, Scene
from illumgrid.field.upright import UPS
from illumgrid.field.volume import Floats, Volume, box_corners, interpolate, world_to_index

if TYPE_CHECKING:
    from illumgrid.show.looks import Layer
    from illumgrid.show.shade import Shown

CUT = 5
"""In addition to the kinds in `illumgrid.constants`: the inside of a solid at a cut."""

_WINDOW = 0.01, 0.99  # quantiles that are shown as black and white


class Clip(NamedTuple):
    """The half space that is shown: of the points x with `normal` · x up to `offset`."""

    normal: Floats
    offset: float


def clips_of(planes: Sequence[str], scene: Scene) -> tuple[Clip, ...]:
    """Clip planes from texts: ``"x=12.5"`` leaves out what lies beyond x = 12.5 in the world, ``"-x=12.5"`` before it.

    A plane beyond which no data lie is omitted.

    Raises
    ------
    BadInput
        On another text, or planes that leave nothing of any volume.

    Warns
    -----
    IllumgridWarning
        `clip`: for each omitted plane.
    """
    boxes = [box_corners(field.volume) for field in scene.fields]
    found: list[Clip] = []
    for text in planes:
        axis, _, place = text.partition("=")
        try:
            at = float(place)
        except ValueError:
            at = np.nan
        if axis not in UPS or not np.isfinite(at):
            raise BadInput(
                f"a clip plane is {text[:60]!r}; expected x=12.5 to leave out what lies beyond it, -x=12.5 for what "
                "lies before it, or the same with y or z, in world units"
            )
        normal = np.asarray(UPS[axis], float)
        found.append(Clip(normal, at * float(normal.sum())))
        along = np.concatenate(boxes) @ np.abs(normal)
        where = f"the data lie at {axis.lstrip('-')} = {shown_range((along.min(), along.max()))}"
        if not any(_left(box, found) for box in boxes):
            raise BadInput(f"the clip plane {text} leaves nothing of the data; expected one that does: {where}")
        if all((box @ normal <= found[-1].offset).all() for box in boxes):
            tell("clip", f"{text} leaves nothing out, {where}", stacklevel=2)
            found.pop()
    return tuple(found)


def _left(corners: Floats, clips: Sequence[Clip]) -> bool:
    """Whether planes leave anything of the upright box around corners (8, 3)."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    for normal, offset in clips:
        axis = int(np.flatnonzero(normal)[0])
        if normal[axis] > 0:
            high[axis] = min(high[axis], offset)
        else:
            low[axis] = max(low[axis], -offset)
    return bool((low <= high).all())


def window(field: Field) -> tuple[float, float]:
    """Values that a cut shows as black and white: quantiles of all data, and of those within the largest solid."""
    stored = field.volume.stored
    some = field.volume.in_units(stored.reshape(-1)[:: max(1, stored.size // 200_000)])
    solid = some[field.solid(some, field.widest)]
    ends = np.quantile(some, _WINDOW)
    ends[1 if field.upward > 0 else 0] = np.quantile(solid if len(solid) else some, _WINDOW[field.upward > 0])
    low, high = map(float, ends)
    return low, high if high > low else low + 1.0


def greys(field: Field, points: Floats) -> NDArray[np.float32]:
    """Display-linear greys (n, 3) of the data at world points (n, 3): sRGB in proportion to the values."""
    volume, (low, high) = field.volume, window(field)
    share = np.clip((interpolate(volume, world_to_index(volume, points)) - low) / (high - low), 0.0, 1.0)
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.repeat(linear.astype(np.float32)[:, None], 3, axis=1)


def clipped_layers(shown: "Shown", eye: Floats, directions: Floats) -> list["Layer"]:
    """What rays along directions (n, 3) from the eye meet within the clip planes: see `illumgrid.show.looks`."""
    from illumgrid.show.engines.software import first_hits
    from illumgrid.show.looks import layers_from

    enter, leave = np.zeros(len(directions)), np.full(len(directions), np.inf)
    for normal, offset in shown.clips:
        along, room = directions @ normal, offset - normal @ eye
        at = np.divide(room, along, out=np.full(len(along), np.inf if room >= 0 else -np.inf), where=along != 0)
        enter = np.where(along < 0, np.maximum(enter, at), enter)
        leave = np.where(along >= 0, np.minimum(leave, at), leave)
    start = eye + enter[:, None] * directions
    held = [_within(field.volume, start) & (enter > 0) for field in shown.scene.fields]
    for k, field in enumerate(shown.scene.fields):
        at = world_to_index(field.volume, start[held[k]])
        held[k][held[k]] = field.solid(interpolate(field.volume, at), shown.row[k])
    films = [field.material.transmission > 0 for field in shown.displayed.fields]
    bits = sum((held[k].astype(np.int64) << k for k in range(len(films)) if films[k]), np.zeros(len(start), np.int64))
    solid = np.full(len(start), -1)
    for k in reversed([k for k, film in enumerate(films) if not film]):
        solid[held[k] & (enter <= leave)] = k
    walls = first_hits(shown, eye, directions, np.full(len(films), np.inf))
    far = np.where(walls.what == QUAD, np.linalg.norm(walls.point - eye, axis=1), np.inf)
    layers = layers_from(shown, start, directions, bits)
    for number, layer in enumerate(layers):
        hits = layer.hits
        t = np.linalg.norm(hits.point - eye, axis=1)
        beyond = (hits.number >= 0) & (hits.what != QUAD) & (t > leave)
        beyond |= (enter > leave) | (t > far) & (layer.weight > 0)
        cut = (solid >= 0) & (enter < far) if number == 0 else np.zeros(len(solid), bool)
        for rows, other in ((beyond & ~cut, walls), (cut, None)):
            for name, values in vars(hits).items():
                values[rows] = _cut(name, start, directions, solid)[rows] if other is None else vars(other)[name][rows]
            if other is not None:
                hits.what[rows & (walls.number < 0)] = MISS
            layer.behind[rows] = 0.0
            for later in layers[number + 1 :]:
                later.weight[rows], later.behind[rows], later.hits.number[rows], later.hits.what[rows] = 0, 0, -1, MISS
    return layers


def _cut(name: str, start: Floats, directions: Floats, solid: NDArray[np.int64]) -> NDArray[np.generic]:
    """Attribute of the `Hits` of cuts."""
    whole: dict[str, NDArray[np.generic]] = {
        "point": start, "normal": -directions, "facing": np.ones(len(start)), "number": solid,
        "what": np.full(len(start), CUT),
    }  # fmt: skip
    return whole[name]


def _within(volume: Volume, points: Floats) -> NDArray[np.bool_]:
    """Whether world points (n, 3) lie in the box of a volume."""
    index = world_to_index(volume, points)
    return np.asarray(((index >= 0) & (index <= np.array(volume.shape) - 1)).all(axis=1))
