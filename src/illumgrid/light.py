"""The result of a run: light for every isosurface of a scene."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from illumgrid import tone
from illumgrid.field.levelset import Marchable, marchable
from illumgrid.field.scene import Levels, Scene
from illumgrid.grid import IlluminationGrid, WallTexture


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
        One a field.
    walls : tuple of WallTexture
        One a quad.
    recipe : mapping
        How it was computed: stages, paths, seconds, versions; all of it JSON.
    """

    scene: Scene
    levels: Levels
    grids: tuple[IlluminationGrid, ...]
    walls: tuple[WallTexture, ...]
    recipe: Mapping[str, Any]

    def grid(self, field: str) -> IlluminationGrid:
        """Illumination grid of the field with this name."""
        return self.grids[self.scene.number_of(field)]

    @cached_property
    def exposure(self) -> float:
        """Automatic exposure: one for all isovalues, views and fields, from the light that the grids hold."""
        lit = [grid.lit for grid in self.grids]
        albedo = [np.broadcast_to(f.material.albedo, e.shape) for f, e in zip(self.scene.fields, lit)]
        return tone.automatic_exposure(np.concatenate(lit), np.concatenate(albedo))

    @cached_property
    def marchable(self) -> Marchable:
        """The scene laid out for rays, for all pictures."""
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

    def show(self, isovalue: float | None = None, height: int = 520) -> Any:
        """View in a notebook: the interactive page, with its isovalue as a synced trait.

        Parameters
        ----------
        isovalue : float, optional
            Of the first field; by default the middle of the range. Later: ``view.isovalue = ...``.
        height : int
            Pixels.

        Returns
        -------
        anywidget.AnyWidget
            ``ipywidgets`` can observe and link its trait ``isovalue``.

        Raises
        ------
        BadInput
            If the package anywidget is missing: ``illumgrid[notebook]`` brings it.
        """
        from illumgrid.show.viewer.widget import widget

        return widget(self, isovalue, height)

    def _repr_png_(self) -> bytes:
        """Still picture, as a notebook shows it."""
        from illumgrid.show import png, render

        return png(render(self, width=640, height=480))

    def save(self, folder: str | os.PathLike[str], *, preview: bool = True, overwrite: bool = False) -> None:
        """Write a folder that holds everything: see `illumgrid.load`.

        Raises
        ------
        BadInput
            If the folder holds a finished run and not `overwrite`, or anything that is not ours.
        """
        from illumgrid.io import store
        from illumgrid.show import png, render

        store.claim(folder, overwrite)
        picture = png(render(self)) if preview else None
        recipe = {**self.recipe, "exposure": self.exposure}
        store.write(folder, store.Stored(self.scene, self.levels, self.grids, self.walls, recipe), picture, overwrite)
