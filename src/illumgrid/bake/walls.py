"""The light of walls: queries at texels, textures from their samples, and lookups between texels."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.scene import Levels, Quad, Scene
from illumgrid.field.volume import Floats
from illumgrid.grid import WallTexture, fill_holes
from illumgrid.grid.walls import calmed
from illumgrid.transport.samples import Queries, Samples


def wall_queries(scene: Scene, levels: Levels) -> list[Queries]:
    """Queries at the middles of the texels of every quad's front, for every row of levels: one batch per quad."""
    counts = [len(levels.table) * quad.texels[0] * quad.texels[1] for quad in scene.quads]
    return [at_texels(scene, levels, number, np.arange(count)) for number, count in enumerate(counts)]


def at_texels(scene: Scene, levels: Levels, quad: int, texels: NDArray[np.int64]) -> Queries:
    """Queries at the middles of some texels of a quad, by their numbers (n,) in an array (rows, v, u)."""
    number, wall = quad + len(scene.fields), scene.quads[quad]
    nu, nv = wall.texels
    rows, v, u = np.unravel_index(texels, (len(levels.table), nv, nu))
    point = wall.corner + ((u + 0.5) / nu)[:, None] * wall.edge_u + ((v + 0.5) / nv)[:, None] * wall.edge_v
    return Queries(
        id=texels.astype(np.uint64) | np.uint64(number << 40),
        point=point,
        normal=np.tile(wall.normal, (len(rows), 1)),
        level=levels.table[rows],
        target=np.full(len(rows), number, np.int32),
    )


def texel_paths(nodes: int, texels: int) -> int:
    """Paths from a texel for each from a node: up to eight, unless walls would then take more work than the grids.

    A texel covers many pixels, so its noise shows as blotches that a curved surface would hide.
    """
    return int(np.clip(nodes // max(texels, 1), 1, 8))


def wall_texture(rows: int, quad: Quad, answer: Samples) -> WallTexture:
    """The texture of a quad from the samples at its texels, for so many rows of levels, with its noise averaged."""
    nu, nv = quad.texels
    support = (answer.paths > 0).astype(np.float32).reshape(rows, nv, nu)
    texel = np.linalg.norm(quad.edge_v) / nv, np.linalg.norm(quad.edge_u) / nu
    # Another row is another setting of the sweep: use it last.
    spacing = (1e3 * max(texel) * max(nu, nv), *texel)
    shape = rows, nv, nu
    calm = calmed(
        answer.light.reshape(*shape, -1), answer.mean.reshape(*shape, 3), answer.error.reshape(shape), support
    )
    light = fill_holes(spacing, calm, support)
    return WallTexture(light, support, answer.channels)


def place_on_walls(scene: Scene, asked: Queries) -> tuple[NDArray[np.intp], Floats, Floats, Floats]:
    """For queries on walls (n,): the number of the quad, u and v along its edges, and t in the sweep."""
    number = asked.target.astype(int) - len(scene.fields)
    uv = np.zeros((len(asked), 2))
    for k in np.unique(number):
        quad, own = scene.quads[k], number == k
        edges = np.stack([quad.edge_u, quad.edge_v], axis=1)
        uv[own] = np.linalg.lstsq(edges, (asked.point[own] - quad.corner).T, rcond=None)[0].T
    return number, uv[:, 0], uv[:, 1], scene.fields[0].place(asked.level[:, 0])


def look_up_walls(scene: Scene, walls: Sequence[WallTexture], asked: Queries) -> Floats:
    """Light (n, 3) of the textures at queries on walls."""
    number, u, v, t = place_on_walls(scene, asked)
    light = np.zeros((len(asked), 3))
    for k in np.unique(number):
        own = number == k
        light[own] = walls[k].lookup(u[own], v[own], t[own])
    return light
