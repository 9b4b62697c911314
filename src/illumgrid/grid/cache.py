"""Grids and walls as a cache: paths that meet a surface may end there and take the stored light.

G. J. Ward, F. M. Rubinstein and R. D. Clear, "A ray tracing solution for diffuse interreflection", SIGGRAPH 1988;
J. Křivánek and P. Gautron, "Practical Global Illumination with Irradiance Caching", 2009.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.scene import Scene
from illumgrid.field.volume import Floats, slabs
from illumgrid.grid.channels import channels_of
from illumgrid.grid.illumination import IlluminationGrid
from illumgrid.grid.walls import WallTexture

ALIKE = 0.3
"""Range of a cell's nodes, relative to the mean light of the grid, above which paths continue."""


class Cache(NamedTuple):
    """Light at the nodes of lattices, one per field, then one per quad, laid out for kernels.

    A wall's lattice has the axes row of the sweep, v, u. A cell is named by its lowest node.
    """

    light: NDArray[np.float32]  # (N, C) irradiance, all lattices one after the other, C order
    trusted: NDArray[np.bool_]  # (N,) cells in which a path may end
    start: NDArray[np.int64]  # (F + Q,) offset of each lattice; empty if there is no cache
    shape: NDArray[np.int64]  # (F + Q, 3)
    origin: Floats  # (F, 3) frame position of node 0
    spacing: Floats  # (F, 3)
    near: Floats  # (F + Q,) distance below which a ray is too short to end: neighbours would light themselves
    sweep: Floats  # (F, 2) levels at the two ends of the sweep, as stored and with the sign of the solid
    after: int = 0  # reflections before a path may end


NO_CACHE = Cache(
    np.zeros((0, 1), np.float32), np.zeros(0, bool), np.zeros(0, np.int64), np.zeros((0, 3), np.int64),
    np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2)),
)  # fmt: skip
"""A cache with which every path continues to its end."""
NO_CACHE.light.flags.writeable = False


def cache_of(
    scene: Scene, grids: Sequence[IlluminationGrid], walls: Sequence[WallTexture], alike: float = ALIKE, after: int = 0
) -> Cache:
    """Lay out the light of a scene as a cache.

    Cells with a hole, or whose nodes differ by more than `alike` of the mean light, are not trusted: there the light
    is not continuous, or the lattice too coarse for it.

    Parameters
    ----------
    scene : Scene
    grids : sequence of IlluminationGrid
        One a field, as baked for this scene.
    walls : sequence of WallTexture
        One a quad.
    alike : float
        Infinite to trust all cells without holes.
    after : int
        Reflections before a path may end; each reduces the influence of the cache's error.

    Raises
    ------
    BadInput
        If grids or walls are not one for each field and quad of the scene, in its channels.
    """
    channels = channels_of(scene)
    lattices: list[IlluminationGrid | WallTexture] = [*grids, *walls]
    if (len(grids), len(walls)) != (len(scene.fields), len(scene.quads)):
        raise BadInput(
            f"{len(grids)} grids and {len(walls)} walls came as a cache; expected {len(scene.fields)} and "
            f"{len(scene.quads)}, those of the scene"
        )
    for lattice in lattices:
        if lattice.channels.names != channels.names:
            raise BadInput(
                f"the light of the cache has the channels {', '.join(lattice.channels.names)}; expected those of the "
                f"scene: {', '.join(channels.names)}"
            )
    light, trusted = [], []
    for lattice in lattices:
        if isinstance(lattice, IlluminationGrid):
            found, lit = lattice.lattice()
        else:
            found, lit = lattice.light, lattice.support > 0
        trusted.append(_alike(lattice.channels.shown(found).mean(axis=-1), lit, alike).reshape(-1))
        light.append(found.reshape(-1, len(channels)))
    texel = [max(np.linalg.norm(q.edge_u) / q.texels[0], np.linalg.norm(q.edge_v) / q.texels[1]) for q in scene.quads]
    return Cache(
        light=light[0] if len(light) == 1 else np.concatenate(light),
        trusted=np.concatenate(trusted),
        start=np.cumsum([0, *map(len, light)], dtype=np.int64)[:-1],
        shape=np.array([*(g.spec.shape for g in grids), *(w.light.shape[:3] for w in walls)], np.int64),
        origin=np.ascontiguousarray(scene.to_frame([grid.spec.origin for grid in grids])),
        spacing=np.array([grid.spec.spacing for grid in grids], float),
        near=np.array([*(grid.spec.spacing.max() for grid in grids), *texel], float),
        sweep=np.array([field.upward * field.volume.to_stored(field.sweep) for field in scene.fields], float),
        after=after,
    )


def _alike(light: NDArray[np.float32], lit: NDArray[np.bool_], alike: float) -> NDArray[np.bool_]:
    """Cells (nx, ny, nz), named by their lowest node, whose nodes all have similar light of their own."""
    mean = float(light[lit].mean(dtype=float)) if lit.any() else 0.0
    found = np.empty(light.shape, bool)
    for some in slabs(light.shape):
        ahead = slice(some.start, some.stop + 1)
        low, high, good = light[ahead], light[ahead], lit[ahead]
        for axis in range(3):
            other = np.minimum(np.arange(low.shape[axis]) + 1, low.shape[axis] - 1)
            low = np.minimum(low, low.take(other, axis))
            high = np.maximum(high, high.take(other, axis))
            good = good & good.take(other, axis)
        found[some] = (good & (high - low <= alike * mean))[: some.stop - some.start]
    return found
