"""Measurements of speed and accuracy: ``python benchmarks/chart.py [PART...] [--volumes DIR] [--json FILE] [--quick]``.

targets
    Errors and times reached by `--error` and `--seconds` on six scenes of 48³ voxels, against a reference.
stages
    `direct` with `nearest` against every other sampler and interpolator, each at its best setting, at equal error.
budgets
    Error within a time, on a smooth field of 96³ (forty Gaussians) and the MRI `stroke_T1`, raw and smoothed.
break_even
    Number of isovalues from which a grid is cheaper than path tracing each isosurface anew at equal error.
volumes
    `bench` on real volumes (charts as PNG beside the JSON file), and `run`'s default relative to the Pareto front.
judgements
    Errors that `run` reports for one grid, over twelve seeds, where light comes by few paths.
defaults
    The default nodes and paths of `run` compared with others, `direct` with `nearest`, on real volumes.

All use a white sky (the floor the light of a studio, the box its lamp), albedo 0.8, 6 bounces unless the pilot chooses
them, and the backend numba. Real volumes are read from DIR, by default ../shared/volumes from the repository's root;
missing ones are skipped.
"""

import argparse
import json
import os
import time
import warnings
from pathlib import Path

import numpy as np
from rays import gaussians

from illumgrid import Queries, Scene, Volume, backend, isosurface, read_volume, run
from illumgrid.accuracy.chart import bench, sizes
from illumgrid.accuracy.chart.contestants import methods, tracers
from illumgrid.accuracy.chart.race import SEEDS, Race, front
from illumgrid.accuracy.choose import planned
from illumgrid.accuracy.judge import judge
from illumgrid.accuracy.points import unseen_in_volume, unseen_on_level_sets
from illumgrid.accuracy.reference import begin, converge, errors
from illumgrid.bake.accumulator import Bake
from illumgrid.bake.around import look_up
from illumgrid.cli.report import files
from illumgrid.field.filters import smooth
from illumgrid.field.scene import level_table
from illumgrid.transport.tracer import prepare

ROOT = Path(__file__).resolve().parents[1]
BOUNCES = 6
RANGES = {
    "nucleon.nrrd": (40, 200), "fuel.nrrd": (15, 200), "neghip.nrrd": (30, 180), "hydrogen_atom.nrrd": (12, 80),
    "stroke_T1.nii.gz": (60, 110), "aquarius-A2.nrrd": (60, 150), "betaGal.mrc.gz": (0.05, 0.13),
    "Bi2O3_ch0.nrrd": (0.05, 0.4), "benzene-homo.nrrd": (0.01, 0.08), "vis_male.nrrd": (40, 70),
}  # fmt: skip


def labyrinth(voxels=48):
    x, y, z = np.meshgrid(*[4.5 * np.linspace(-1, 1, voxels)] * 3, indexing="ij")
    return Volume(np.sin(x) * np.cos(y) + np.sin(y) * np.cos(z) + np.sin(z) * np.cos(x))


def noisy(voxels=48):
    field = gaussians(voxels).values
    return Volume(field + np.random.default_rng(0).normal(scale=0.03, size=field.shape))


def fields():
    return {
        "forty Gaussians": Scene.sky(gaussians(48), range=(0.2, 1.2)),
        "the same, noisy": Scene.sky(noisy(), range=(0.3, 1.0)),
        "labyrinth": Scene.sky(labyrinth(), range=(-0.4, 0.4)),
        "colored": Scene.sky(gaussians(48, seed=5), (0.4, 0.6, 0.9), range=(0.3, 1.2)),
        "on a floor": Scene.floor(gaussians(48, count=15, seed=9), range=(0.2, 0.8)),
        "in the box": Scene.box(gaussians(48), range=(0.2, 0.9)),
    }


def truth_of(scene, error=0.002, levels=40, points=8000, bounces=32, paths=4096):
    asked = unseen_on_level_sets(scene, levels, points, 77)
    tracer = prepare(backend("numba"), scene)
    return converge(begin(tracer, asked, bounces, 77), error, paths)


def off(light, truth):
    return errors(look_up(light.grids, truth.queries)[0], truth)


def timed(scene, **options):
    begun = time.perf_counter()
    light = run(scene, **options)
    return light, time.perf_counter() - begun


def targets(asked):
    """Ratios of reached to requested errors and times."""
    found = []
    for name, scene in fields().items():
        rough = name == "in the box"  # its errors are larger, and a path takes five times as long
        truth = truth_of(scene, 0.02 if rough else 0.003, paths=1024 if rough else 4096)
        for option, values in (
            ("error", (0.1, 0.05) if rough else (0.05, 0.02, 0.01)),
            ("seconds", (5, 15) if asked.quick else (5, 20, 60)),
        ):
            for value in values:
                light, seconds = timed(scene, **{option: value}, isovalues=4, seed=3)
                reached, plan = off(light, truth).rmse, light.recipe["plan"]
                ratio = reached / value if option == "error" else seconds / value
                found.append(
                    {"field": name, option: value, "ratio": ratio, "rmse": reached, "took": seconds, "plan": plan,
                     "judged": light.recipe["reached"]}
                )  # fmt: skip
                chosen = f"grid {plan['grid']}, {plan['paths']} paths, met {plan['met']}"
                reports = f"{reached:7.2%} (reported {light.recipe['reached']:6.2%}) in {seconds:6.1f} s"
                print(f"  {name:22} {option} {value:<5} {reports}, ratio {ratio:5.2f}, {chosen}", flush=True)
    error = [f["ratio"] for f in found if "error" in f and f["plan"]["met"]]
    seconds = [f["ratio"] for f in found if "seconds" in f and f["plan"]["met"]]
    print(f"  errors within a factor of 1.3: {np.mean(np.array(error) <= 1.3):.0%} of {len(error)}; "
          f"times within 20 %: {np.mean(np.abs(np.array(seconds) - 1) <= 0.2):.0%} of {len(seconds)}")  # fmt: skip
    return found


def race_of(scene, budget):
    """A race with a fixed number of bounces, run to the end of its budget."""
    truth = truth_of(scene, 0.004, levels=24, points=2400, bounces=BOUNCES)
    found, _ = tracers(scene, truth.queries, budget)
    entrants = methods([m for m in found if m.backend.name == "numba" and m.surface == "levelset"])
    race = Race(scene, {"levelset": truth}, entrants, sizes(scene), BOUNCES, 0)
    begun = time.perf_counter()
    # `bench` reserves time to repeat settings with more seeds, which is not done here.
    while setting := race.next(SEEDS * (budget - (time.perf_counter() - begun))):
        race.advance(setting)
    return race


def stages(asked):
    """Time of each method, at its best setting, relative to direct with nearest at equal error."""
    cases = {"forty Gaussians": fields()["forty Gaussians"], "labyrinth": fields()["labyrinth"]}
    if (place := asked.volumes / "stroke_T1.nii.gz").exists():
        cases["stroke_T1, smoothed"] = Scene.sky(smooth(read_volume(place), 1.0), range=(60, 110))
    found = {}
    for name, scene in cases.items():
        race = race_of(scene, 60 if asked.quick else 120)
        exact = race.references["levelset"]
        curves = {}
        for p in race.points:
            curves.setdefault(f"{p.method.sampler.name}, {p.interpolator.name}", []).append(p)
        best_of = {label: front(points, race.references) for label, points in sorted(curves.items())}
        own = best_of["direct, nearest"]
        times, rmse = np.log([p.time for p in own]), np.log([p.rmse(exact) for p in own])
        for label, best in best_of.items():
            # The time of direct at the error of each of their points, interpolated on its own front.
            ratios = [
                float(p.time / np.exp(np.interp(-np.log(p.rmse(exact)), -rmse, times)))
                for p in best
                if np.exp(rmse.min()) <= p.rmse(exact) <= np.exp(rmse.max())
            ]
            found.setdefault(name, {})[label] = {"ratios": ratios, "best": [(p.time, p.rmse(exact)) for p in best]}
            shown = ", ".join(f"{ratio:.1f}" for ratio in ratios) or "no point at an error that direct reaches"
            least = f"least error {best[-1].rmse(exact):7.2%} in {best[-1].time:6.1f} s"
            print(f"  {name:20} {label:18} {least}; time relative to direct: {shown}")
    return found


def budgets(asked):
    """Error of two fields within a time."""
    cases = {"forty Gaussians, 96": (Scene.sky(gaussians(96), range=(0.2, 1.2)), 20, (96, 64))}
    if (place := asked.volumes / "stroke_T1.nii.gz").exists():
        raw = read_volume(place)
        cases["stroke_T1, raw"] = Scene.sky(raw, range=(60, 110)), 120, (320, 160)
        cases["stroke_T1, --smooth 1"] = Scene.sky(smooth(raw, 1.0), range=(60, 110)), 120, (240, 160)
    found = {}
    for name, (scene, seconds, grids) in cases.items():
        truth = truth_of(scene, 0.002 if "Gaussians" in name else 0.01, bounces=BOUNCES)
        tries = [{"seconds": 0.9 * seconds, "bounces": BOUNCES}]
        tries += [{"seconds": 0.9 * seconds, "bounces": BOUNCES, "grid": grid} for grid in grids]
        for options in tries:
            light, took = timed(scene, **options, isovalues=4)
            e = off(light, truth)
            entry = {"options": options, "took": took, **vars(e), "grid": light.recipe["grid"]}
            found.setdefault(name, []).append(entry)
            print(f"  {name:24} grid {light.recipe['grid']:4}, {light.recipe['paths']:4} paths: {took:6.1f} s, "
                  f"error {e.rmse:.2%}, median {e.median:.2%}")  # fmt: skip
    return found


def break_even(asked):
    """Number of isovalues from which the grid is cheaper than path tracing every isosurface anew, at equal error."""
    cases = {"forty Gaussians": fields()["forty Gaussians"]}
    if (place := asked.volumes / "stroke_T1.nii.gz").exists():
        cases["stroke_T1, smoothed"] = Scene.sky(smooth(read_volume(place), 1.0), range=(60, 110))
    found = {}
    for name, scene in cases.items():
        plan, _ = planned(scene, prepare(backend("numba"), scene), level_table(scene, 4), error=0.03, bounces=BOUNCES)
        light, whole = timed(scene, judge=False, grid=plan.grid, paths=plan.paths, bounces=BOUNCES, isovalues=4)
        each, lookup = [], []
        for t in (0.2, 0.5, 0.8):
            level = float(scene.levels(t)[0, 0])
            vertices = isosurface(scene.fields[0].volume, level).vertices  # needed by both
            begun = time.perf_counter()
            points = Queries.at(scene, vertices, level=level)
            tracer = prepare(backend("numba"), scene)
            one, other = (Bake.of([points], BOUNCES, s).walk(tracer, range(16)).samples for s in (0, 1))
            tracing = (time.perf_counter() - begun) / 2
            noise = np.sqrt(((one.mean - other.mean)[one.paths > 0] ** 2).mean() / 2) / one.mean.mean()
            each.append(tracing * max(1.0, 16 * (noise / 0.03) ** 2) / 16)  # for the paths that equal the error
            begun = time.perf_counter()
            light.grids[0].lookup(vertices)
            lookup.append(time.perf_counter() - begun)
        after = whole / max(1e-9, np.mean(each) - np.mean(lookup))
        found[name] = {"grid_seconds": whole, "each_seconds": each, "lookup_seconds": lookup, "isovalues": after}
        print(f"  {name:20} grid {whole:.1f} s, each isosurface {np.mean(each):.2f} s, lookup {np.mean(lookup):.3f} s: "
              f"breaks even after {after:.0f} isovalues")  # fmt: skip
    return found


def judgements(asked):
    """Reported errors of a grid in the box, where few paths carry the light, against a reference on other points."""
    scene = fields()["in the box"]
    tracer = prepare(backend("numba"), scene)
    light = run(scene, grid=40, paths=128, bounces=8, seed=0, judge=False)
    exact = converge(begin(tracer, unseen_in_volume(scene, 2000, 50), 32, 50), 0.02, 256)
    about = light.recipe["queries"], 128, 8

    def held(asked):
        return look_up(light.grids, asked)[0]

    reported = [judge(scene, tracer, unseen_in_volume, held, seed, *about) for seed in range(12)]
    rmse, true = [e.rmse for e in reported], off(light, exact).rmse
    uncertain = [e.uncertain for e in reported]
    print(f"  error {true:.2%}; reported {min(rmse):.2%} to {max(rmse):.2%}, {np.mean(rmse):.2%} on average, spread "
          f"{np.std(rmse, ddof=1):.2%}, reported uncertainty {np.mean(uncertain):.2%}")  # fmt: skip
    return {"rmse": true, "reported": rmse, "uncertain": uncertain}


def volumes(asked):
    """Charts of real volumes, and error and time of run's default relative to the front."""
    found = {}
    for name, limits in RANGES.items():
        if not (asked.volumes / name).exists():
            continue
        scene = Scene.sky(read_volume(asked.volumes / name), range=limits)
        result = bench(scene, 40 if asked.quick else 80)
        content, summary = files(result, name.split(".")[0], scene)
        (asked.json.parent / f"chart-{name.split('.')[0]}.png").write_bytes(content["chart.png"])
        exact = result.references["levelset"]
        default = next((p for p in result.points if p.default), None)
        if default is None:  # its first look would take too much of the budget
            print(f"  {name:20} {'; '.join(result.notes)}", flush=True)
            continue
        took, rmse = default.time, default.rmse(exact)
        error = {p: p.rmse(result.references[p.method.surface]) for p in result.points}
        dominating = [p for p in result.front if p.time < took and error[p] < rmse]
        advice = summary.splitlines()[-1]
        found[name] = {
            "default": {"seconds": took, "built": default.built, "rmse": rmse, "dominated by": len(dominating)},
            "truth": exact.error, "least": min(e for p, e in error.items() if p.method.surface == "levelset"),
            "advice": advice,
        }  # fmt: skip
        better = [
            f"{p.method.label(p.interpolator)} {p.grid} x {p.paths} ({p.time:.1f} s, {error[p]:.2%})"
            for p in dominating
        ]
        least = found[name]["least"]
        print(f"  {name:20} default {'' if default.built else '~'}{took:.1f} s {rmse:7.2%}; dominated by "
              f"{', '.join(better) or 'none'}; reference {exact.error:.2%}, "
              f"least error {least / exact.error:.1f} times that", flush=True)  # fmt: skip
        print(f"    {advice}", flush=True)
    return found


def defaults(asked):
    """The default of `run` and other nodes and paths on real volumes: `direct`, `nearest`, the same reference."""
    tried = ((0.6, 128), (0.85, 64), (1.0, 64), (1.2, 16), (1.2, 32), (1.2, 64), (1.41, 16), (1.9, 8))
    found = {}
    for name, limits in RANGES.items():
        if not (asked.volumes / name).exists():
            continue
        scene = Scene.sky(read_volume(asked.volumes / name), range=limits)
        longest = min(125, max(scene.fields[0].volume.shape))  # 1.2 nodes per voxel is then the default
        truth = truth_of(scene, 0.01, levels=24, points=6000, paths=512)
        found[name] = []
        for density, paths in tried:
            light, took = timed(scene, judge=False, grid=round(density * longest), paths=paths, isovalues=4)
            found[name].append((density, paths, took, off(light, truth).rmse))
        took = {(d, p): (t, e) for d, p, t, e in found[name]}
        own = took[1.2, 32]
        shown = "; ".join(f"{d:g} x {p}: {t / own[0]:.2f}, {e:.2%}" for (d, p), (t, e) in took.items())
        print(f"  {name:20} default {own[0]:.2f} s; nodes x paths: relative time, error: {shown}", flush=True)
    return found


PARTS = {part.__name__: part for part in (targets, stages, budgets, break_even, volumes, judgements, defaults)}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], help="by default all")
    parser.add_argument("--volumes", type=Path, default=ROOT.parent / "shared" / "volumes")
    parser.add_argument("--json", type=Path, default=ROOT / "benchmarks" / "chart.json")
    parser.add_argument("--quick", action="store_true", help="smaller budgets")
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    figures = json.loads(asked.json.read_text("utf-8")) if asked.json.exists() else {}
    for part in asked.parts or PARTS:
        print(f"{part} ({os.cpu_count()} cores, load {os.getloadavg()[0]:.1f})")
        figures[part] = PARTS[part](asked)
        asked.json.write_text(json.dumps(figures, indent=1, default=float) + "\n")


if __name__ == "__main__":
    main()
