"""Reading lit nodes trilinearly and by place, level and slope: ``python benchmarks/reading.py [FIELD...]``.

For each field (nucleon, neghip, the hydrogen atom, a block of 40³ voxels of the MRI `stroke_T1`, raw and smoothed; by
default all that lie in ``../shared/volumes``) the same lit nodes are read trilinearly and by `bilateral` at several
densities of stored nodes, against converged light at unseen isovalues: relative RMSE, median, bias, seconds, and how
many references the bars cover.

``--level``, ``--turn`` and ``--ridge`` change the widths of the weights, for a trial: kernels are then compiled anew.
"""

import argparse
import os
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
BOUNCES = 6


def fields(folder):
    """Scene and nodes along the longest axis of each field by name."""
    from illumgrid import Scene, read_volume
    from illumgrid.field.filters import smooth

    def block(volume, side=40):
        at = [(n - side) // 2 for n in volume.shape]
        stored = volume.stored[tuple(slice(a, a + side) for a in at)]
        return replace(volume, stored=stored)

    made = {
        "nucleon": ("nucleon.nrrd", (40, 200), 49, lambda v: v),
        "neghip": ("neghip.nrrd", (30, 180), 77, lambda v: v),
        "hydrogen": ("hydrogen_atom.nrrd", (12, 80), 64, lambda v: v),
        "stroke": ("stroke_T1.nii.gz", (60, 110), 48, block),
        "smoothed": ("stroke_T1.nii.gz", (60, 110), 48, lambda v: smooth(block(v), 1.0)),
    }
    return {
        name: (Scene.sky(change(read_volume(folder / file)), range=limits), grid)
        for name, (file, limits, grid, change) in made.items()
        if (folder / file).exists()
    }


def measured(grid, reference):
    """What is off, and the coverage of the bars, in words."""
    from illumgrid.accuracy.reference import errors
    from illumgrid.bake.around import look_up

    points = reference.queries.point
    e = errors(look_up([grid], reference.queries)[0], reference)
    off = np.sqrt(((grid.lookup(points) - reference.light) ** 2).mean(axis=1))
    bar = np.hypot(grid.uncertainty(points), np.sqrt((reference.off**2).mean(axis=1)))
    known = np.isfinite(bar)
    covered = np.mean(off[known] <= 1.96 * bar[known] + 1e-6)
    said = f"{e.rmse:7.2%} median {e.median:6.2%} bias {e.bias:+6.2%} covered {covered:6.1%}"
    return f"{said} resolution {grid.resolution:.2f}"


def measure(name, scene, longest, densities):
    """Print one field."""
    from illumgrid import backend
    from illumgrid.accuracy.points import unseen_on_level_sets
    from illumgrid.accuracy.reference import begin, converge
    from illumgrid.grid import GridSpec, Nodes
    from illumgrid.interpolators.bilateral import Bilateral
    from illumgrid.interpolators.nearest import Nearest
    from illumgrid.samplers.direct import Direct
    from illumgrid.transport.samples import join_queries
    from illumgrid.transport.tracer import prepare

    tracer = prepare(backend("numba"), scene)
    reference = converge(begin(tracer, unseen_on_level_sets(scene, 40, 3000, 77), BOUNCES, 77), 0.006, 1024)
    for nodes_along, paths in ((longest, 32), (longest, 8), (round(0.7 * longest), 8)):
        spec = GridSpec.over(scene.fields[0].volume, nodes_along)
        nodes = Nodes(spec, scene.fields[0])
        asked = join_queries(list(Direct().queries(scene, [spec], 0)))
        begun = time.perf_counter()
        samples = tracer.solve(asked, paths=range(paths), bounces=BOUNCES, seed=0)
        took = time.perf_counter() - begun
        said = f"{len(asked)} nodes lit in {took:.2f} s; reference {reference.error:.2%}"
        print(f"{name} {nodes_along} x {paths}: {said}")
        print(f"  trilinear        {measured(Nearest().fill(samples, nodes), reference)}", flush=True)
        for density in densities:
            begun = time.perf_counter()
            grid = Bilateral(density).fill(samples, nodes)
            took = time.perf_counter() - begun
            said = f"{measured(grid, reference)}; {np.count_nonzero(grid.support)} nodes in {took:.2f} s"
            print(f"  bilateral x {density:<4g} {said}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("fields", nargs="*", help="by default all")
    parser.add_argument("--volumes", type=Path, default=ROOT.parent / "shared" / "volumes")
    parser.add_argument("--densities", type=float, nargs="+", default=[1.0, 1.5, 2.0, 3.0])
    widths = ("level", "turn", "ridge")
    for width in widths:
        parser.add_argument(f"--{width}", type=float)
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    changed = {width.upper(): getattr(asked, width) for width in widths if getattr(asked, width) is not None}
    if changed:
        os.environ["NUMBA_CACHE_DIR"] = tempfile.mkdtemp()  # compiled code is kept by its text, not by its constants
    from illumgrid.grid import reading

    for constant, value in changed.items():
        setattr(reading, constant, value)
    for name, (scene, longest) in fields(asked.volumes).items():
        if not asked.fields or name in asked.fields:
            measure(name, scene, longest, asked.densities)


if __name__ == "__main__":
    main()
