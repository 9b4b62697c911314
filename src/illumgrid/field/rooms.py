"""Walls around a volume, and the resolution of their light."""

from dataclasses import replace

import numpy as np

from illumgrid.field.quads import Material, Quad
from illumgrid.field.volume import Floats, Volume, index_to_world


def upright(direction: Floats) -> tuple[Floats, Floats, Floats]:
    """World directions (3,) right, front and up: signed axes of an array with this `direction`.

    Up is the axis nearest to world +z, front the remaining axis nearest to -y (the face, in medical coordinates).
    """
    heights = direction[2]
    vertical = int(np.argmax(np.abs(heights)))
    depths = np.where(np.arange(3) == vertical, 0.0, -direction[1])
    level = int(np.argmax(np.abs(depths)))
    up = direction[:, vertical] * np.sign(heights[vertical])
    front = direction[:, level] * (np.sign(depths[level]) or 1.0)
    return np.cross(up, front), front, up


def _upright_box(volume: Volume) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Right, front, up, and the centre and half extents (along those) of the box of a volume's voxel centres."""
    axes = np.stack(upright(volume.direction), axis=1)
    last = np.array(volume.shape) - 1.0
    half = 0.5 * np.abs(axes.T @ (volume.direction * (last * volume.spacing))).sum(axis=1)
    return axes[:, 0], axes[:, 1], axes[:, 2], index_to_world(volume, last / 2), half


def _wall(name: str, centre: Floats, u: Floats, v: Floats, albedo: Floats) -> Quad:
    """Parallelogram with half edges u and v around its centre; its front is u × v."""
    return Quad(name, centre - u - v, 2 * u, 2 * v, Material(albedo))


def square_texels(quad: Quad, per_length: float) -> Quad:
    """The quad with texels that are as square as possible, so many per world unit."""
    edges = (float(np.linalg.norm(edge)) for edge in (quad.edge_u, quad.edge_v))
    nu, nv = (max(1, round(per_length * edge)) for edge in edges)
    return replace(quad, texels=(nu, nv))


def _texel(volume: Volume, longest: float) -> int:
    """Texels along a wall of this length beside a volume: one for about three voxels, at least 6 and at most 48."""
    side = float((np.array(volume.shape) * volume.spacing).max())
    return int(np.clip(round(longest / side * max(volume.shape) / 3.3), 6, 48))


def fitting_texels(quad: Quad, volume: Volume) -> Quad:
    """A wall beside a volume with square texels, as many as in `box_around`; one texel if it reflects no light."""
    if not quad.material.albedo.any():
        return replace(quad, texels=(1, 1))
    longest = max(float(np.linalg.norm(edge)) for edge in (quad.edge_u, quad.edge_v))
    return square_texels(quad, _texel(volume, longest) / longest)


def box_around(volume: Volume, margin: float = 0.25) -> tuple[Quad, ...]:
    """Six inward-facing walls around a volume, and a luminaire close above the floor; `margin` in half extents."""
    right, front, up, centre, half = _upright_box(volume)
    half = half + margin * half.max()
    r, f, u = right * half[0], front * half[1], up * half[2]
    white, red, green = np.full(3, 0.75), np.array([0.63, 0.06, 0.05]), np.array([0.14, 0.45, 0.09])
    lamp = Quad(
        "lamp", centre - 0.98 * u - 0.4 * r + 0.4 * f, 0.8 * r, -0.8 * f, Material(np.zeros(3), np.full(3, 8.0)), (1, 1)
    )
    walls = (
        _wall("floor", centre - u, r, -f, white),
        _wall("ceiling", centre + u, r, f, white),
        _wall("left", centre - r, f, -u, red),
        _wall("right", centre + r, f, u, green),
        _wall("back", centre - f, r, u, white),
        _wall("front", centre + f, r, -u, white),
    )
    longest = 2 * float(half.max())
    fine = _texel(volume, longest) / longest  # twice that on the floor, where the lamp is near and shadows are sharp
    return (*(square_texels(wall, 2 * fine if wall.name == "floor" else fine) for wall in walls), lamp)


def floor_under(volume: Volume, grey: float) -> Quad:
    """A wide floor that a volume stands on."""
    right, front, up, centre, half = _upright_box(volume)
    reach = 2.2 * half[:2].max()
    ground = _wall("floor", centre - half[2] * up, reach * right, -reach * front, np.full(3, grey))
    return square_texels(ground, 2 * _texel(volume, 2 * reach) / (2 * reach))
