"""The result in words and numbers: records, a table, and which setting to use."""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from illumgrid.accuracy.chart.race import Point
from illumgrid.accuracy.chart.whence import Bar
from illumgrid.accuracy.truth import Truth, errors

GOALS = (0.01, 0.03, 0.1)
"""Relative errors for which a setting is recommended."""


def record(point: Point, truths: dict[str, Truth], on_front: bool) -> dict[str, Any]:
    """A point of the chart as JSON and CSV have it; shares are of the mean light."""
    truth = truths[point.way.surface]
    each = [errors(light, truth) for light in point.light]
    several = len(each) > 1
    return {
        "contestant": point.label,
        "sampler": point.way.sampler.name,
        "backend": point.way.backend.name,
        "interpolator": point.interpolator.name,
        "options": {
            kind: asdict(stage)  # type: ignore[call-overload]
            for kind, stage in (
                ("sampler", point.way.sampler),
                ("backend", point.way.backend),
                ("interpolator", point.interpolator),
            )
        },
        "surface": point.way.surface,
        "grid": point.grid,
        "paths": point.paths,
        "queries": point.queries,
        "seeds": len(each),
        "seconds": point.time,
        "seconds_spread": float(np.std(point.seconds, ddof=1)) if several else None,
        "rmse": float(np.mean([e.rmse for e in each])),
        "rmse_spread": float(np.std([e.rmse for e in each], ddof=1)) if several else None,
        "median": float(np.mean([e.median for e in each])),
        "p95": float(np.mean([e.p95 for e in each])),
        "bias": float(np.mean([e.bias for e in each])),
        "uncovered": float(1 - point.covered.mean()),
        "flip": point.flip,
        "memory_mb": point.memory,
        "front": on_front,
        "default": point.default,
        "built": point.built,
    }


def table(records: Sequence[dict[str, Any]]) -> str:
    """The front, what `run` does by default, and of everybody else the best, as text."""
    rows = [r for r in records if r["front"]]
    default = [r for r in records if r["default"] and not r["front"]]
    seen = {r["contestant"] for r in rows}
    rest = sorted((r for r in records if r["contestant"] not in seen), key=lambda r: r["rmse"])
    others = []
    for r in rest:
        if r["contestant"] not in seen:
            seen.add(r["contestant"])
            others.append(r)
    wide = max(len(r["contestant"]) for r in records)
    heads = [f"{head:>8}" for head in ("seconds", "error", "+-", "median", "95 %", "bias", "FLIP", "MB")]
    lines = [f"{'contestant':{wide}} {'grid':>5} {'paths':>6} {' '.join(heads)}"]
    for name, part in (
        ("the front:", sorted(rows, key=lambda r: r["seconds"])),
        ("run's default:", default),
        ("the best of the others:", others),
    ):
        if part:
            lines.append(name)
        for r in part:
            spread = "" if r["rmse_spread"] is None else f"{r['rmse_spread']:.2%}"
            seconds = f"{'' if r['built'] else '~'}{r['seconds']:.2f}"
            setting = f"{r['contestant']:{wide}} {r['grid']:5} {r['paths']:6} {seconds:>8}"
            off = f"{r['rmse']:8.2%} {spread:>8} {r['median']:8.2%} {r['p95']:8.2%} {r['bias']:+8.2%}"
            flip = "" if r["flip"] is None else f"{r['flip']:.4f}"
            memory = "" if r["memory_mb"] is None else f"{r['memory_mb']:.0f}"
            lines.append(f"{setting} {off} {flip:>8} {memory:>8}".rstrip())
    return "\n".join(lines)


def options(record: dict[str, Any], bounces: int) -> str:
    """A setting as options of ``illumgrid run``."""
    told = [f"--{kind} {record[kind]}" for kind in ("sampler", "backend", "interpolator")]
    if count := record["options"]["sampler"].get("count"):
        told.append(f"--isovalues {count}")
    if record["options"]["backend"].get("surface") == "mesh":
        told.append("--set backend.surface=mesh")
    return " ".join([*told, f"--grid {record['grid']} --paths {record['paths']} --bounces {bounces}"])


def advice(records: Sequence[dict[str, Any]], bars: Sequence[Bar], bounces: int) -> list[str]:
    """Which setting to use at each of the goals, in sentences."""
    best = sorted((r for r in records if r["front"]), key=lambda r: r["seconds"])
    told = []
    for goal in GOALS:
        good = [r for r in best if r["rmse"] <= goal]
        if good:
            r = good[0]
            told.append(f"for {goal:.0%} use {options(r, bounces)} ({came(r)})")
    told += [standing(r, best, bounces) for r in records if r["default"]]
    missed = [f"{goal:.0%}" for goal in GOALS if goal < best[-1]["rmse"]]
    if missed:
        r = best[-1]
        told.append(
            f"{' and '.join(missed)} was not reached within this budget; the nearest was {options(r, bounces)} "
            f"({came(r)}), whose error is mostly {mostly(r, bars)}"
        )
    return told


def came(record: dict[str, Any]) -> str:
    """Seconds and error of a setting."""
    seconds = f"{record['seconds']:.0f}" if record["seconds"] >= 10 else f"{record['seconds']:.2g}"
    return f"{'' if record['built'] else 'about '}{seconds} s, error {record['rmse']:.2%}"


def standing(default: dict[str, Any], best: Sequence[dict[str, Any]], bounces: int) -> str:
    """Where `run`'s default stands against the front (from fast to accurate)."""
    own = f"run's default ({came(default)})"
    if default["front"]:
        return f"{own} is on the front"
    better = min((r for r in best if r["seconds"] <= default["seconds"]), key=lambda r: r["rmse"])
    return f"{own} is beaten by {options(better, bounces)} ({came(better)})"


def mostly(record: dict[str, Any], bars: Sequence[Bar]) -> str:
    """The largest part of the error at a setting, and what lessens it."""
    near = min(bars, key=lambda b: (abs(np.log(b.grid / record["grid"])), abs(np.log(b.paths / record["paths"]))))
    parts = {
        "noise: more paths": near.split.noise,
        "the grid's: more nodes, or --smooth 1 if the data are noisy": near.split.grid,
        "where no sample is: more nodes": near.split.uncovered,
        "bounces left out: more bounces": near.split.bounces,
    }
    return max(parts, key=lambda name: parts[name])
