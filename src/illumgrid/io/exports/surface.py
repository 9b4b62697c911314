"""A surface with its light as the colour of its vertices: glTF (``.glb``) and PLY."""

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput, shown, shown_range
from illumgrid.field.levelset import isosurface
from illumgrid.field.onto import onto_levels
from illumgrid.io import needs
from illumgrid.io.exports.arrays import display_linear
from illumgrid.io.readers.mesh import Y_UP
from illumgrid.tone import decode_srgb, encode_srgb

if TYPE_CHECKING:
    import trimesh

    from illumgrid.bake.accumulator import Progress
    from illumgrid.light import Illumination


@dataclass(frozen=True, eq=False)
class LitSurface:
    """A surface and the light on it.

    Parameters
    ----------
    field : str
    isovalue : float or None
        None where each vertex lies on the level set through itself.
    exposure : float
    mesh : trimesh.Trimesh
        World units, open where the solid meets the border of the volume.
    linear : (n, 3) float32
        albedo/π · irradiance · exposure at the vertices, clamped to 0 .. 1, or the mesh's own colours.
    colors : str
        Description of `linear`.
    shade : (n,) float32, optional
        Brightness of a white surface, for a given mesh: see `Illumination.shade`.
    """

    field: str
    isovalue: float | None
    exposure: float
    mesh: "trimesh.Trimesh"
    linear: NDArray[np.float32]
    colors: str = "albedo/pi * irradiance * exposure"
    shade: NDArray[np.float32] | None = None

    def about(self) -> dict[str, Any]:
        """Information for a reader of the file."""
        about: dict[str, Any] = {"field": self.field}
        if self.isovalue is not None:
            about["isovalue"] = self.isovalue
        return about | {"exposure": self.exposure, "colors": self.colors}


def lit(light: "Illumination", number: int, isovalue: float | None, progress: "Progress") -> LitSurface:
    """Extract an isosurface of field `number`, by default that in the middle of its range, and look up its light."""
    field = light.scene.fields[number]
    ends = (low, high) = tuple(float(x) for x in field.range)
    level = 0.5 * (low + high) if isovalue is None else float(isovalue)
    if not low <= level <= high:
        raise BadInput(
            f"the isovalue is {shown(level, ends, 6)}, but the light of field {field.name!r} is that of "
            f"{shown_range(ends, 6)}; choose "
            "one within, or compute the light of a wider range"
        )
    needs.check_surface(field, level, "smooth the volume, or downsample it")
    progress("surface", 0, 2)
    mesh = isosurface(field.volume, level, field.inside)
    if not len(mesh.faces):
        ends = field.volume.extremes
        raise BadInput(
            f"field {field.name!r} has no surface at isovalue {level:g}: its values are "
            f"{shown_range(ends, 6)}; choose an isovalue between"
        )
    progress("surface", 1, 2)
    colour = display_linear(light, number, light.grids[number].lookup(mesh.vertices))
    progress("surface", 2, 2)
    progress("file", 0, 1)
    return LitSurface(field.name, level, light.exposure, mesh, np.clip(colour, 0.0, 1.0))


def lit_onto(
    light: "Illumination", number: int, isovalue: float | None, mesh: "trimesh.Trimesh", linear: bool
) -> LitSurface:
    """Light for a given mesh; its own colours are kept, and are `linear` or sRGB."""
    field = light.scene.fields[number]
    points = onto_levels(field, mesh.vertices, isovalue)
    shade = light.shade(points, field.name)
    visual: Any = mesh.visual
    if visual.kind in ("vertex", "face"):
        own = np.asarray(visual.vertex_colors)[:, :3]
        color = (own / np.float32(255)).astype(np.float32) if linear else decode_srgb(own)
        return LitSurface(field.name, isovalue, light.exposure, mesh, color, "those of the mesh", shade)
    color = np.clip(display_linear(light, number, light.grids[number].lookup(points)), 0.0, 1.0)
    return LitSurface(field.name, isovalue, light.exposure, mesh, color, shade=shade)


def write_glb(path: Path, surface: LitSurface) -> None:
    """Write binary glTF 2.0: linear float colours, unlit, y up; the mesh's extras describe the colours.

    trimesh writes vertex colours as bytes, in which dark linear light shows bands; a float attribute avoids that.
    Positions are single precision, relative to the mesh's centre; a node of the file places and turns them.
    """
    import trimesh

    centre = surface.mesh.bounds.mean(axis=0)
    mesh = trimesh.Trimesh(surface.mesh.vertices - centre, surface.mesh.faces, process=False)
    mesh.vertex_attributes["_color"] = surface.linear
    if surface.shade is not None:
        mesh.vertex_attributes["_LIGHT"] = surface.shade
    mesh.metadata.update(surface.about())
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = Y_UP, Y_UP @ centre
    scene = trimesh.Scene()
    scene.add_geometry(mesh, geom_name=surface.field, node_name=surface.field, transform=place)
    scene.metadata.clear()
    path.write_bytes(trimesh.exchange.gltf.export_glb(scene, include_normals=False, tree_postprocessor=_unlit))


def _unlit(tree: dict[str, Any]) -> None:
    """Use the attribute as colour, with a material that no lamp of a viewer lights."""
    tree["asset"]["generator"] = f"illumgrid {version('illumgrid')} with {tree['asset']['generator']}"
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    base = {"baseColorFactor": [1, 1, 1, 1], "metallicFactor": 0, "roughnessFactor": 1}  # for viewers without unlit
    tree["materials"] = [
        {"name": "light", "extensions": {"KHR_materials_unlit": {}}, "pbrMetallicRoughness": base, "doubleSided": True}
    ]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["attributes"]["COLOR_0"] = primitive["attributes"].pop("_color")
            primitive["material"] = 0


def write_ply(path: Path, surface: LitSurface) -> None:
    """Write binary PLY: world coordinates, sRGB bytes, and comments that describe the colours."""
    import trimesh

    mesh = trimesh.Trimesh(surface.mesh.vertices, surface.mesh.faces, process=False)
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=encode_srgb(surface.linear))
    if surface.shade is not None:
        mesh.vertex_attributes["light"] = surface.shade
    content = trimesh.exchange.ply.export_ply(mesh, vertex_normal=False)
    about = {"illumgrid": version("illumgrid"), **surface.about(), "encoding": "sRGB"}
    comments = "".join(f"comment {key} {value}\n" for key, value in about.items())
    head = b"format binary_little_endian 1.0\n"
    path.write_bytes(content.replace(head, head + comments.encode("ascii", "backslashreplace"), 1))
