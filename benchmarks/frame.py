"""Cost of a new isovalue, part by part: ``python benchmarks/frame.py [--engine egl] [--json FILE]``.

The field is a sum of forty Gaussians on 128³ and on 256³ voxels, with an illumination grid of 96³ nodes and pictures of
800 x 600. A frame consists of extraction (the capped isosurface and which of its faces are caps), lookup (the light at
every vertex), tone (sRGB), and drawing (all other OpenGL work, the transfer included). It is compared with the same
frame with one constant vertex colour, which is cheaper than any local light. The added cost of global light is thus an
upper bound of its added cost over local light. `--local` of ``illumgrid preview`` is timed too: its gradient normals
cost more than the lookup.

The frames take turns. Times are medians over rounds, in wall time; shares are within one round. The rate of the lookup
is that of the fastest round, in time of one thread. If VTK is installed, its flying edges are timed on the same field.
"""

import argparse
import importlib.util
import json
import time
from dataclasses import replace

import numpy as np
from rays import ISOVALUE, gaussians, race

from illumgrid import Scene, isosurface
from illumgrid.field.scene import level_table
from illumgrid.grid import GridSpec, IlluminationGrid
from illumgrid.light import Illumination
from illumgrid.show import BACKGROUND, choose_engine, fit_camera, triangles
from illumgrid.show.engines import gl
from illumgrid.show.shade import Shown, opaque
from illumgrid.tone import srgb_curve

NODES, WIDTH, HEIGHT = 96, 800, 600


def lit(volume):
    """Illumination with arbitrary smooth light."""
    scene = Scene.sky(volume, range=(0.2, 0.9))
    spec = GridSpec.over(volume, NODES)
    wave = 2 + np.sin(np.indices(spec.shape).sum(axis=0) / 9)
    values = (wave[..., None] * np.array([1.0, 0.9, 0.8])).astype(np.float32)
    grid = IlluminationGrid(spec, values, np.zeros(spec.shape), np.ones(spec.shape))
    return Illumination(scene, level_table(scene, 2), (grid,), (), {"seed": 0})


def flying_edges(values):
    """VTK's extraction of the same level set."""
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk

    image = vtk.vtkImageData()
    image.SetDimensions(*values.shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel()))
    filter = vtk.vtkFlyingEdges3D()
    filter.SetInputData(image)
    filter.SetValue(0, ISOVALUE)
    filter.ComputeNormalsOff()
    filter.Update()


def measure(voxels, engine, rounds):
    """All measurements for one field size."""
    light = lit(gaussians(voxels))
    field, row = light.scene.fields[0], np.array([ISOVALUE])
    camera, ground = fit_camera(light.scene, row, WIDTH / HEIGHT), opaque(np.full(3, BACKGROUND, np.float32))
    shown = Shown(light, row, 0.5, local=False)
    plain = triangles.seen(shown, camera.eye)
    points = plain[0].points
    colors, facing = shown.field(0, points, np.zeros(len(points))), np.zeros(len(points))
    parts = {
        "frame": lambda: drawn(triangles.seen(shown, camera.eye)),
        "triangles": lambda: triangles.seen(shown, camera.eye),
        "lookup and exposure": lambda: shown.field(0, points, facing),
        "tone": lambda: srgb_curve(colors),
        "draw": lambda: drawn(plain),
        "isosurface": lambda: isosurface(field.volume, ISOVALUE, capped=True),
        "local frame": lambda: drawn(triangles.seen(replace(shown, local=True), camera.eye)),
    }
    if importlib.util.find_spec("vtk"):
        parts["VTK flying edges"] = lambda: flying_edges(field.volume.values)

    def drawn(triangles):
        return gl.draw(triangles, camera, WIDTH, HEIGHT, ground, engine)

    seconds = race(parts.values(), rounds, time.perf_counter)
    rate = len(points) / race([lambda: light.grids[0].lookup(points)], 20).min() / 1e6
    times = dict(zip(parts, seconds.T))
    extraction = times["triangles"] - times["lookup and exposure"]
    light_time, drawing = times["lookup and exposure"] + times["tone"], times["draw"] - times["tone"]
    return {
        "vertices": len(points),
        "extraction ms": 1e3 * float(np.median(extraction)),
        "of which scikit-image and trimesh ms": 1e3 * float(np.median(times["isosurface"])),
        "lookup ms": 1e3 * float(np.median(times["lookup and exposure"])),
        "tone ms": 1e3 * float(np.median(times["tone"])),
        "drawing ms": 1e3 * float(np.median(drawing)),
        "whole frame ms": 1e3 * float(np.median(times["frame"])),
        "frame with --local ms": 1e3 * float(np.median(times["local frame"])),
        "light adds %": 100 * float(np.median(light_time / (extraction + drawing))),
        "lookup, million points per second": rate,
        **{f"{n} ms": 1e3 * float(np.median(times[n])) for n in ("VTK flying edges",) if n in times},
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", default="auto", help="egl, osmesa, or auto")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", help="file for the measurements")
    asked = parser.parse_args()
    engine, why = choose_engine(asked.engine)
    print(f"engine: {engine} ({why})")
    if engine == "software":
        parser.error("no OpenGL is available; expected EGL or OSMesa")
    figures = {voxels: measure(voxels, engine, asked.rounds) for voxels in (128, 256)}
    for name in figures[128]:
        print(f"{name:36} {figures[128][name]:10.1f} {figures[256][name]:10.1f}")
    if asked.json:
        with open(asked.json, "w") as file:
            json.dump(figures, file, indent=2)


if __name__ == "__main__":
    main()
