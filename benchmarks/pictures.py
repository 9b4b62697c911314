"""Redraw the pictures of ``docs/images``: ``python benchmarks/pictures.py FOLDER [--paths N] [--only NAME]``.

FOLDER holds the volumes, which are not part of the project; each picture's caption names the source of its data. The
light has print quality and takes minutes per picture on two cores. The pictures are drawn in software, so that they are
the same on every machine. ``--keep DIR`` stores the light in DIR, or reads it from there if it exists.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import illumgrid as ig
from illumgrid.field.scene import upright
from illumgrid.field.volume import index_to_world, smooth
from illumgrid.show import render

IMAGES = Path(__file__).parents[1] / "docs" / "images"


def studio(volume, albedo, limits, sky=0.22, lamp=8.0):
    """A volume under a dim sky and a large lamp above its front: soft shadows, and some light in the clefts."""
    scene = ig.Scene.sky(volume, albedo, limits)
    right, front, up = upright(volume.direction)
    extent = (np.array(volume.shape) - 1) * volume.spacing
    toward = 0.85 * up + 0.5 * front - 0.05 * right
    toward /= np.linalg.norm(toward)
    across = np.cross(up, toward)
    across /= np.linalg.norm(across)
    u, v = 0.6 * extent.max() * across, -0.6 * extent.max() * np.cross(toward, across)
    middle = index_to_world(volume, (np.array(volume.shape) - 1) / 2) + 1.5 * extent.max() * toward
    light = ig.Material(np.zeros(3), np.full(3, lamp))
    return replace(
        scene, quads=(ig.Quad("lamp", middle - u - v, 2 * u, 2 * v, light, (1, 1)),), background=np.full(3, sky)
    )


def brain(folder):
    """MRI of a human brain: the README's first picture."""
    volume = smooth(ig.read_volume(folder / "stroke_T1.nii.gz"), 0.8)
    return studio(volume, (0.78, 0.6, 0.52), (60, 110)), 160, {"isovalue": 85.0}


def neuron(folder):
    """A neuron over a floor, under a lamp: shadows show how high each branch runs."""
    whole = ig.read_volume(folder / "rivulet_neuron.nrrd")  # crop to the middle: two thin arms extend far outwards
    volume = smooth(ig.Volume(whole.values[45:195, 80:335, :105], spacing=whole.spacing), 1.0)
    scene = ig.Scene.floor(volume, albedo=(0.8, 0.62, 0.3), range=(10, 40))
    floor = replace(scene.quads[0], texels=(160, 160))
    size = np.abs(floor.edge_u).max()
    corner = floor.corner + 0.2 * floor.edge_u + 0.7 * floor.edge_v + [0, 0, 0.9 * size]
    shine = ig.Material(np.zeros(3), np.array([40.0, 38.0, 34.0]))
    lamp = ig.Quad("lamp", corner, 0.2 * floor.edge_v, 0.2 * floor.edge_u, shine, texels=(1, 1))
    scene = replace(scene, quads=(floor, lamp), background=np.full(3, 0.35))
    return scene, 200, {"isovalue": 14.0, "view": (-35.0, 50.0), "zoom": 1.05}


PICTURES = {"brain": brain, "neuron": neuron}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--paths", type=int, default=128)
    parser.add_argument("--grid", type=int, help="instead of each picture's own")
    parser.add_argument("--only", choices=PICTURES)
    parser.add_argument("--keep", type=Path)
    asked = parser.parse_args()
    for name in [asked.only] if asked.only else PICTURES:
        scene, grid, how = PICTURES[name](asked.folder)
        kept = asked.keep / name if asked.keep else None
        if kept and kept.exists():
            light = ig.load(kept)
        else:
            light = ig.run(scene, grid=asked.grid or grid, paths=asked.paths)
            if kept:
                light.save(kept, preview=False)
        for local in (True, False):
            picture = render(light, width=880, height=800, local=local, **how)
            Image.fromarray(picture).save(IMAGES / f"{name}{'-local' if local else ''}.webp", quality=90, method=6)
        print(name, light.recipe["seconds"])


if __name__ == "__main__":
    main()
