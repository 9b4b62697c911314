"""The result of `illumgrid bench` as records, files and text, with recommended settings."""

import csv
import io
import json
import os
import platform
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

import numpy as np

from illumgrid import registry
from illumgrid.accuracy.chart import Report
from illumgrid.accuracy.chart.race import Point
from illumgrid.accuracy.reference import Reference, errors
from illumgrid.field.scene import Scene

Record = dict[str, Any]

GOALS = (0.01, 0.03, 0.1)
"""Relative errors for which a setting is recommended."""

REMEDIES = {
    "noise": "noise; increase --paths",
    "grid": "interpolation between nodes; increase --grid, or pass --smooth 1 if the data are noisy",
    "uncovered": "uncovered regions; increase --grid",
    "bounces": "truncated bounces; increase --bounces",
}


def described(report: Report, name: str, scene: Scene) -> Record:
    """The whole report in types of JSON."""
    best = set(map(id, report.front))
    records = [record(p, report.references, id(p) in best) for p in report.points]
    parts = [{"nodes": m.grid, "paths": m.paths, **asdict(m.parts), "total": m.parts.total} for m in report.parts]
    return {
        "input": name,
        "fields": [
            {"name": f.name, "shape": f.volume.shape, "range": f.range.tolist(), "inside": f.inside}
            for f in scene.fields
        ],
        "bounces": report.bounces,
        "seconds": report.seconds,
        "machine": {"system": platform.system(), "processor": platform.machine(), "cores": os.cpu_count()},
        "versions": {package: version(package) for package in ("illumgrid", "numpy", "numba")},
        "truth": {
            surface: {
                "points": len(reference),
                "isovalues": len(set(reference.queries.level[:, 0].tolist())),
                **{key: getattr(reference, key) for key in ("paths", "bounces", "mean", "error")},
            }
            for surface, reference in report.references.items()
        },
        "advice": advice(records, parts, report.bounces),
        "notes": list(report.notes),
        "points": records,
        "parts": parts,
    }


def record(point: Point, references: dict[str, Reference], on_front: bool) -> Record:
    """A point of the chart as a row of JSON and CSV; errors are relative to the mean light."""
    method, filler = point.method, point.interpolator
    stages = {"sampler": method.sampler, "backend": method.backend, "interpolator": filler}
    each = [errors(light, references[method.surface]) for light in point.light]
    several = len(each) > 1
    return {
        "contestant": method.label(filler),
        **{kind: stage.name for kind, stage in stages.items()},
        "options": {kind: asdict(stage) for kind, stage in stages.items()},
        "surface": method.surface,
        "grid": point.longest,
        "paths": point.paths,
        "queries": point.queries,
        "seeds": len(each),
        "seconds": point.time,
        "seconds_spread": float(np.std(point.seconds, ddof=1)) if several else None,
        "rmse": float(np.mean([e.rmse for e in each])),
        "rmse_spread": float(np.std([e.rmse for e in each], ddof=1)) if several else None,
        **{key: float(np.mean([getattr(e, key) for e in each])) for key in ("median", "p95", "bias")},
        "uncovered": float(1 - point.covered.mean()),
        "flip": point.flip,
        "memory_mb": point.memory,
        "front": on_front,
        "default": point.default,
        "built": point.built,
        "looked": method.looked,
    }


def options(record: Record, bounces: int) -> str:
    """A setting as options of ``illumgrid run``."""
    if record["looked"]:  # it chooses the number of bounces by itself
        return f"--backend {record['backend']} --paths {record['paths']}"
    words = [f"--{kind} {record[kind]}" for kind in ("sampler", "backend", "interpolator")]
    if count := record["options"]["sampler"].get("count"):
        words.append(f"--isovalues {count}")
    if record["options"]["backend"].get("surface") == "mesh":
        words.append("--set backend.surface=mesh")
    usual = asdict(registry.make("interpolator", record["interpolator"], {}))
    changed = record["options"]["interpolator"].items() - usual.items()
    words += [f"--set interpolator.{name}={value}" for name, value in sorted(changed)]
    return " ".join([*words, f"--grid {record['grid']} --paths {record['paths']} --bounces {bounces}"])


def advice(records: Sequence[Record], parts: Sequence[Record], bounces: int) -> list[str]:
    """Which setting to use at each of the goals, in sentences."""
    best = sorted((r for r in records if r["front"]), key=lambda r: r["seconds"])
    found = []
    for goal in GOALS:
        if r := next((r for r in best if r["rmse"] <= goal), None):
            found.append(f"for {goal:.0%} use {options(r, bounces)} ({cost(r)})")
    found += [standing(r, best, bounces) for r in records if r["default"]]
    last = best[-1]
    if missed := [f"{goal:.0%}" for goal in GOALS if goal < last["rmse"]]:
        were = "was" if len(missed) == 1 else "were"
        nearest = f"the nearest was {options(last, bounces)} ({cost(last)})"
        why = "" if last["looked"] else f", whose error is dominated by {dominant(last, parts)}"
        found.append(f"{' and '.join(missed)} {were} not reached within this budget; {nearest}{why}")
    return found


def cost(record: Record) -> str:
    """Seconds and error of a setting."""
    seconds = f"{record['seconds']:.0f}" if record["seconds"] >= 10 else f"{record['seconds']:.2g}"
    return f"{'' if record['built'] else 'about '}{seconds} s, error {record['rmse']:.2%}"


def standing(default: Record, best: Sequence[Record], bounces: int) -> str:
    """The position of `run`'s default relative to the Pareto front (sorted from fast to accurate)."""
    own = f"run's default ({cost(default)})"
    if default["front"]:
        return f"{own} is on the front"
    better = min((r for r in best if r["seconds"] <= default["seconds"]), key=lambda r: r["rmse"])
    return f"{own} is dominated by {options(better, bounces)} ({cost(better)})"


def dominant(record: Record, parts: Sequence[Record]) -> str:
    """The largest part of the error at a setting, and how to reduce it."""
    near = min(
        parts, key=lambda p: (abs(np.log(p["nodes"] / record["grid"])), abs(np.log(p["paths"] / record["paths"])))
    )
    return REMEDIES[max(REMEDIES, key=lambda name: near[name])]


def files(report: Report, name: str, scene: Scene) -> tuple[dict[str, bytes], str]:
    """Content of every file, and the text for the terminal."""
    from illumgrid.show import chart

    made = described(report, name, scene)
    records, points = made["points"], max(about["points"] for about in made["truth"].values())
    title = f"{name}: {report.bounces} bounces, reference at {points} points"
    figure = chart.draw(records, made["parts"], title)
    content = {
        "bench.json": json.dumps(made, indent=1).encode() + b"\n",
        "bench.csv": _csv(records),
        "chart.png": chart.image(figure, "png"),
        "chart.svg": chart.image(figure, "svg"),
    }
    notes = [f"note: {note}" for note in report.notes]
    return content, "\n".join([table(records), *notes, f"{name}: " + "; ".join(made["advice"])])


def _csv(records: Sequence[Record]) -> bytes:
    text = io.StringIO()
    columns = [key for key in records[0] if key != "options"]
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue().encode()


def table(records: Sequence[Record]) -> str:
    """The Pareto front, the default of `run`, and the best point of every other contestant, as text."""
    best = sorted((r for r in records if r["front"]), key=lambda r: r["seconds"])
    default = [r for r in records if r["default"] and not r["front"]]
    seen, others = {r["contestant"] for r in best}, []
    for r in sorted(records, key=lambda r: r["rmse"]):
        if r["contestant"] not in seen:
            seen.add(r["contestant"])
            others.append(r)
    wide = max(len(r["contestant"]) for r in records)
    heads = [f"{head:>8}" for head in ("seconds", "error", "+-", "median", "95 %", "bias", "FLIP", "MB")]
    lines = [f"{'contestant':{wide}} {'grid':>5} {'paths':>6} {' '.join(heads)}"]
    for name, part in (("the front:", best), ("run's default:", default), ("the best of the others:", others)):
        lines += [name] * bool(part)
        for r in part:
            spread = "" if r["rmse_spread"] is None else f"{r['rmse_spread']:.2%}"
            seconds = f"{'' if r['built'] else '~'}{r['seconds']:.2f}"
            setting = f"{r['contestant']:{wide}} {r['grid']:5} {r['paths']:6} {seconds:>8}"
            off = f"{r['rmse']:8.2%} {spread:>8} {r['median']:8.2%} {r['p95']:8.2%} {r['bias']:+8.2%}"
            flip = "" if r["flip"] is None else f"{r['flip']:.4f}"
            memory = "" if r["memory_mb"] is None else f"{r['memory_mb']:.0f}"
            lines.append(f"{setting} {off} {flip:>8} {memory:>8}".rstrip())
    return "\n".join(lines)
