"""A sweep in a desktop window: as in the paper, each isovalue is extracted and lit by a lookup.

PyVista has a slider and runs wherever VTK does; pyrender's viewer has keys only, and needs an old release of pyglet.
"""

from typing import Any

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.light import Illumination
from illumgrid.show.camera import fit_camera, outline_of
from illumgrid.show.shade import BACKGROUND, Shown
from illumgrid.show.triangles import solid, wall
from illumgrid.tone import encode_srgb


class Window:
    """A window whose slider sweeps a lit scene; `plotter` is PyVista's.

    Parameters
    ----------
    light : Illumination
    off_screen : bool
        Draw, but open no window.
    up : str, optional
        World direction that is up at first, as in `illumgrid.show.fit_camera`.
    """

    def __init__(self, light: Illumination, off_screen: bool = False, up: str | None = None) -> None:
        try:
            import pyvista
        except ImportError as reason:
            raise BadInput(
                "a window needs the package pyvista, which is missing; install illumgrid[desktop], "
                "or leave out --desktop to look in the browser"
            ) from reason
        self.light = light
        self._pyvista: Any = pyvista
        field = light.scene.fields[0]
        low, high = map(float, field.range)
        self.plotter = self._pyvista.Plotter(off_screen=off_screen, title="illumgrid", window_size=[1100, 800])
        self.plotter.set_background([float(c) / 255 for c in encode_srgb(np.full(3, BACKGROUND))])
        self._look((low + high) / 2, 1100 / 800, up)
        self.sweep((low + high) / 2)
        self.plotter.add_slider_widget(
            self.sweep, (low, high), title=f"isovalue of {field.name}", interaction_event="always", fmt="%.4g",
            pointa=(0.25, 0.08), pointb=(0.75, 0.08), color="white", style="modern",
        )  # fmt: skip

    def _look(self, isovalue: float, aspect: float, up: str | None = None) -> None:
        """The camera of the still picture, which rotates about the middle of the scene."""
        scene = self.light.scene
        row = scene.levels_through(0, isovalue)[0]
        seen, outline = fit_camera(scene, row, aspect, up=up), outline_of(scene, row)
        middle = (outline.min(axis=0) + outline.max(axis=0)) / 2
        camera = self.plotter.camera
        camera.position = seen.eye
        camera.focal_point = seen.eye + max(float((middle - seen.eye) @ seen.forward), 1e-9) * seen.forward
        camera.up = seen.up
        camera.view_angle = float(np.degrees(2 * np.arctan(seen.tangent)))

    def sweep(self, isovalue: float) -> None:
        """Extract the isosurfaces at this setting of the sweep, look up their light, and show them."""
        scene = self.light.scene
        row = scene.levels_through(0, isovalue)[0]
        shown = Shown(self.light, row, float(np.clip(scene.fields[0].place(isovalue), 0.0, 1.0)), False)
        eye = np.asarray(self.plotter.camera.position, float)
        solids = [piece for k, field in enumerate(scene.fields) for piece in solid(shown, k, field, eye)]
        walls = [wall(shown, k, eye) for k in range(len(scene.quads))]
        for number in range(2 * len(scene.fields) + len(walls)):  # components without a surface at this isovalue
            self.plotter.remove_actor(f"piece {number}", reset_camera=False, render=False)
        for number, piece in enumerate(solids + walls):
            if not len(piece.faces):
                continue
            mesh = self._pyvista.PolyData(piece.points, np.insert(piece.faces, 0, 3, axis=1).ravel())
            mesh["rgb"] = encode_srgb(piece.colors)
            self.plotter.add_mesh(
                mesh, scalars="rgb", rgb=True, lighting=False, name=f"piece {number}", reset_camera=False, render=False,
                culling="back" if number >= len(solids) else None,  # walls are seen from the front only
            )  # fmt: skip
        self.plotter.reset_camera_clipping_range()
        self.plotter.render()


def show(light: Illumination, up: str | None = None) -> None:
    """Open a window and return when it is closed; `up` as in `Window`."""
    Window(light, up=up).plotter.show()
