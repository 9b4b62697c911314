"""The result of a run: light for every isosurface of a scene."""

import difflib
import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid import tone
from illumgrid.errors import BadInput
from illumgrid.field.layers import layers_of
from illumgrid.field.levelset import Marchable, marchable
from illumgrid.field.lights import Distant, Harmonics, Sky, projected, rotated
from illumgrid.field.scene import Levels, Scene
from illumgrid.field.upright import sky_axes
from illumgrid.grid import IlluminationGrid, WallTexture
from illumgrid.grid.channels import mixed

if TYPE_CHECKING:
    import trimesh

    from illumgrid.io.elsewhere import Source
    from illumgrid.show.tints import Tint


@dataclass(frozen=True, eq=False)
class Illumination:
    """Light for every isosurface of a scene.

    Parameters
    ----------
    scene : Scene
        With the fields as used.
    levels : Levels
        The table of isovalues.
    grids : tuple of IlluminationGrid
        One per field.
    walls : tuple of WallTexture
        One per quad.
    recipe : mapping
        How it was computed: stages, paths, seconds, versions; in types of JSON.
    weights : mapping
        Weights of the lights, set by `mix`.
    """

    scene: Scene
    levels: Levels
    grids: tuple[IlluminationGrid, ...]
    walls: tuple[WallTexture, ...]
    recipe: Mapping[str, Any]
    weights: Mapping[str, float] = field(default_factory=dict)

    @property
    def lights(self) -> tuple[str, ...]:
        """Names of the lights that are stored separately, which `mix` takes."""
        return tuple(layer.name for layer in layers_of(self.scene))

    def mix(self, **weights: float) -> "Illumination":
        """The same light with its lights multiplied by weights: no new computation, and no copy of what is stored.

        Parameters
        ----------
        **weights : float
            By the name of a light, relative to the scene; a light that is left out keeps its weight. Names that are not
            Python words: ``light.mix(**{"my lamp": 0.5})``.

        Returns
        -------
        Illumination
            With an exposure of its own. Error bars of grids are an upper bound: each light's error times its absolute
            weight, summed.

        Raises
        ------
        BadInput
            On an unknown name, or a weight that is not finite.
        """
        for name, weight in weights.items():
            if name not in self.lights:
                close = difflib.get_close_matches(name, self.lights, 1)
                hint = f"; did you mean {close[0]!r}?" if close else ""
                known = ", ".join(self.lights) or "none: the scene is dark"
                raise BadInput(f"no light is named {name!r}; expected one of {known}{hint}")
            if not np.isfinite(weight):
                raise BadInput(f"the weight of light {name!r} is {weight}; expected a finite number")
        return self._shown_as(self.scene, {**self.weights, **weights})

    def under(self, sky: Sky | Distant | None, turn: float = 0.0) -> "Illumination":
        """The same light under another sky: for a scene that keeps spherical harmonics, see `Scene.in_harmonics`.

        Parameters
        ----------
        sky : Sky, Distant or None
            As smooth as the harmonics can show it; None is the light of the scene.
        turn : float
            Degrees about up; 90 moves what was behind the object to its right.

        Raises
        ------
        BadInput
            If the scene keeps no harmonics.
        """
        found = [light for light in self.scene.lights if isinstance(light, Harmonics)]
        if not found:
            raise BadInput(
                "this light was not computed for spherical harmonics; expected a run with --lights sh, or "
                "scene.in_harmonics(): run it again"
            )
        degree = math.isqrt(len(found[0].coefficients)) - 1
        new = rotated(projected(found[0] if sky is None else sky, degree, sky_axes(self.scene)), turn)
        lights = tuple(replace(o, coefficients=new) if o is found[0] else o for o in self.scene.lights)
        return self._shown_as(replace(self.scene, lights=lights), self.weights)

    def looking(
        self, field: str | None = None, *, roughness: float | None = None, translucent: float = 0.0
    ) -> "Illumination":
        """The same light with other looks of a field, in pictures only: a clear coat, translucency.

        Parameters
        ----------
        field : str, optional
            By default the first.
        roughness, translucent : float, optional
            As in `Material`.
        """
        number = self.scene.number_of(field)
        old = self.scene.fields[number]
        material = replace(old.material, roughness=roughness, translucent=translucent)
        fields = (*self.scene.fields[:number], replace(old, material=material), *self.scene.fields[number + 1 :])
        return replace(self, scene=replace(self.scene, fields=fields))

    def _shown_as(self, scene: Scene, weights: Mapping[str, float]) -> "Illumination":
        layers = layers_of(scene)
        whole = scene is self.scene and all(weight == 1.0 for weight in weights.values()) and not self.weights
        if whole:
            return self
        grids = tuple(grid.showing(mixed(grid.channels, layers, weights)) for grid in self.grids)
        walls = tuple(
            replace(wall, values=wall.light, channels=mixed(wall.channels, layers, weights)) for wall in self.walls
        )
        return replace(self, scene=scene, grids=grids, walls=walls, weights=weights)

    def grid(self, field: str) -> IlluminationGrid:
        """Illumination grid of the field with this name."""
        return self.grids[self.scene.number_of(field)]

    @cached_property
    def exposure(self) -> float:
        """Automatic exposure: one for all isovalues, views and fields, from the light that the grids hold."""
        count = sum(len(lit) for grid in self.grids for lit in grid.lit_parts())
        if not count:
            return 1.0
        lamps = any(quad.material.emission.any() for quad in self.scene.quads)
        directed = not lamps and any(isinstance(one, Distant) for one in self.scene.lights)
        # One after the other and in place: together and with copies they would need as much memory as the light.
        mean = self._of_lit(lambda lit, albedo: lit.mean(axis=1), np.empty(count, np.float32))
        median = float(np.median(mean, overwrite_input=True))
        del mean
        brightest = self._of_lit(lambda lit, albedo: (lit * albedo).max(axis=1), np.empty(count, np.float32))
        return tone.exposure_under(median, brightest, directed)

    def _of_lit(self, worth: Callable[[Any, Any], Any], out: NDArray[Any]) -> NDArray[Any]:
        """A number for each node that has light of its own, computed in parts from their light (n, 3) and albedo."""
        first = 0
        for field_, grid in zip(self.scene.fields, self.grids):
            for lit in grid.lit_parts():
                found = worth(lit, field_.material.albedo)
                out[first : first + len(found)] = found
                first += len(found)
        return out

    @cached_property
    def marchable(self) -> Marchable:
        """The scene laid out for rays, shared by all pictures."""
        return marchable(self.scene)

    def color(self, points: ArrayLike, field: str | None = None, exposure: float | None = None) -> NDArray[np.uint8]:
        """Display colour of the isosurface at world points.

        Parameters
        ----------
        points : (n, 3) array_like
        field : str, optional
            Name of the field that the surface belongs to; by default the first.
        exposure : float, optional
            By default the automatic one.

        Returns
        -------
        (n, 3) uint8
            sRGB of the tone curve of albedo/π · E · exposure.
        """
        number = self.scene.number_of(field)
        radiance = self.grids[number].lookup(points) * self.scene.fields[number].material.albedo / np.pi
        return tone.encode_srgb(tone.curve(radiance * (self.exposure if exposure is None else exposure)))

    def shade(self, points: ArrayLike, field: str | None = None, exposure: float | None = None) -> NDArray[np.float32]:
        """Brightness (n,) of a white surface at world points, 0 to 1: luminance of the tone curve of E/π · exposure.

        It multiplies colours of another meaning, such as those of a second quantity. Parameters are those of `color`.
        """
        radiance = self.grid(self.scene.fields[self.scene.number_of(field)].name).lookup(points) / np.float32(np.pi)
        return tone.luminance(tone.curve(radiance * np.float32(self.exposure if exposure is None else exposure)))

    def bake(
        self, mesh: "trimesh.Trimesh", field: str | None = None, isovalue: float | None = None
    ) -> "trimesh.Trimesh":
        """A copy of a mesh with light at its vertices, such as an isosurface that was decimated or smoothed.

        Parameters
        ----------
        mesh : trimesh.Trimesh
            World units, on level sets of the field: an isosurface, or the surface of a segmentation.
        field : str, optional
            By default the first.
        isovalue : float, optional
            The level set that all vertices lie on; by default each lies on that through itself.

        Returns
        -------
        trimesh.Trimesh
            With the array ``light`` in its `vertex_attributes`, see `shade`. Where the mesh has colours of its own it
            keeps them; else its vertices have those of `color`.

        Raises
        ------
        BadInput
            If vertices are more than a voxel away from the level sets of the range; the sentence says how many.
        """
        from illumgrid.field.onto import onto_levels

        number = self.scene.number_of(field)
        points = onto_levels(self.scene.fields[number], mesh.vertices, isovalue)
        lit = mesh.copy()
        lit.vertex_attributes["light"] = self.shade(points, field)
        visual: Any = mesh.visual
        if not visual.defined:
            lit.visual = type(visual)(lit, vertex_colors=self.color(points, field))
        return lit

    def show(
        self, isovalue: float | None = None, height: int = 520, up: str | None = None, tint: "Tint | None" = None
    ) -> Any:
        """View in a notebook: the interactive page, with its isovalue as a synced trait.

        Parameters
        ----------
        isovalue : float, optional
            Of the first field; by default the middle of the range. Later: ``view.isovalue = ...``.
        height : int
            Pixels.
        up : {"x", "y", "z", "-x", "-y", "-z"}, optional
            World direction that is up; by default that of the still pictures.
        tint : illumgrid.show.tints.Tint, optional
            A second quantity that colours all fields.

        Returns
        -------
        anywidget.AnyWidget
            ``ipywidgets`` can observe and link its traits ``isovalue`` and ``weights``, by light.

        Raises
        ------
        BadInput
            If the package anywidget is missing: ``illumgrid[notebook]`` brings it.
        """
        from illumgrid.show.viewer.widget import widget

        return widget(self, isovalue=isovalue, height=height, up=up, tint=tint)

    def _repr_png_(self) -> bytes:
        """Still picture, as a notebook shows it."""
        from illumgrid.show import png, render

        return png(render(self, width=640, height=480))

    def save(
        self,
        folder: str | os.PathLike[str],
        *,
        preview: bool = True,
        overwrite: bool = False,
        source: "Source | None" = None,
    ) -> None:
        """Write a folder that holds everything: see `illumgrid.load`.

        Parameters
        ----------
        folder : str or path-like
        preview : bool
            Whether to draw a picture.
        overwrite : bool
        source : illumgrid.io.elsewhere.Source, optional
            The file that the fields come from: the folder then refers to it instead of storing them.

        Raises
        ------
        BadInput
            If the folder holds a finished run without `overwrite`, or anything that is not part of a run.
        """
        from illumgrid.io import store
        from illumgrid.io.record import Stored
        from illumgrid.show import png, render

        store.claim(folder, overwrite)
        picture = png(render(self)) if preview else None
        recipe = {**self.recipe, "exposure": self.exposure}
        if self.weights:
            recipe["weights"] = dict(self.weights)
        stored = Stored(self.scene, self.levels, self.grids, self.walls, recipe, source)
        store.write(folder, stored, picture, overwrite)
