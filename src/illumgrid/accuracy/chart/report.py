"""A report as files and as text."""

import csv
import io
import json
import os
import platform
from dataclasses import asdict
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from illumgrid.accuracy.chart import chart
from illumgrid.accuracy.chart.told import advice, record, table
from illumgrid.field.scene import Scene

if TYPE_CHECKING:
    from illumgrid.accuracy.chart import Report


def files(report: "Report", name: str, scene: Scene) -> tuple[dict[str, bytes], str]:
    """Content of every file, and the text for the terminal."""
    best = set(map(id, report.front))
    records = [record(p, report.truths, id(p) in best) for p in report.points]
    told = advice(records, report.bars, report.bounces)
    figure = chart.draw(records, report.bars, f"{name}: {report.bounces} bounces, truth at {_points(report)} points")
    content = {
        "bench.json": json.dumps(_described(report, name, scene, records, told), indent=1).encode() + b"\n",
        "bench.csv": _csv(records),
        "chart.png": chart.image(figure, "png"),
        "chart.svg": chart.image(figure, "svg"),
    }
    notes = [f"note: {note}" for note in report.notes]
    return content, "\n".join([table(records), *notes, f"{name}: " + "; ".join(told)])


def _points(report: "Report") -> int:
    return max(len(truth) for truth in report.truths.values())


def _described(
    report: "Report", name: str, scene: Scene, records: list[dict[str, Any]], told: list[str]
) -> dict[str, Any]:
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
                "points": len(truth),
                "isovalues": len(set(truth.queries.level[:, 0].tolist())),
                "paths": truth.paths,
                "bounces": truth.bounces,
                "mean": truth.mean,
                "error": truth.error,
            }
            for surface, truth in report.truths.items()
        },
        "advice": told,
        "notes": list(report.notes),
        "points": records,
        "parts": [{"grid": b.grid, "paths": b.paths, **asdict(b.split), "total": b.split.total} for b in report.bars],
    }


def _csv(records: list[dict[str, Any]]) -> bytes:
    text = io.StringIO()
    columns = [key for key in records[0] if key != "options"]
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return text.getvalue().encode()
