"""The speed-accuracy chart: seconds against error, and the parts of the error, drawn from the records of `bench`."""

import io
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = ("#1b6ca8", "#d1495b", "#3c8d5a", "#b07d12", "#7a4fa3", "#2a9d9d", "#8c564b", "#555555")
MARKERS = "osD^vP*X<>hd"
PARTS = {
    "noise": ("noise", "#8fb8de"),
    "grid": ("interpolation between nodes", "#1b6ca8"),
    "uncovered": ("uncovered", "#d1495b"),
    "bounces": ("truncated bounces", "#e0a030"),
}
SHOWN = 10
"""Contestants with a colour and a line of the legend; the others are grey dots."""

COLUMNS = 4
"""Of the legend."""

LABEL = (45.0, 11.0)
"""Pixels of a label."""


def draw(records: Sequence[dict[str, Any]], shares: Sequence[dict[str, Any]], title: str) -> "Figure":
    """Figure with the race on the left, and the sources of the error of `direct` with `nearest` on the right."""
    from matplotlib.figure import Figure

    rows = -(-(min(SHOWN + 1, len({r["contestant"] for r in records})) + 3) // COLUMNS)
    figure = Figure(figsize=(13, 6 + 0.17 * rows), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1.55, 1))
    race(left, records)
    parts(right, shares)
    handles, names = left.get_legend_handles_labels()  # below both axes, so that it hides nothing however long it is
    figure.legend(handles, names, loc="outside lower center", ncols=COLUMNS, fontsize=8, frameon=False)
    figure.suptitle(title, fontsize=12)
    return figure


def race(axes: "Axes", records: Sequence[dict[str, Any]]) -> None:
    """Seconds against relative error, both logarithmic; the front as a line with the spread over the seeds."""
    from matplotlib.ticker import LogLocator, NullFormatter

    best: dict[str, tuple[bool, float]] = {}
    for r in records:
        before = best.get(r["contestant"], (False, float("inf")))
        best[r["contestant"]] = (before[0] or r["front"], min(before[1], r["rmse"]))
    names = sorted(best, key=lambda name: (not best[name][0], best[name][1]))
    front = sorted((r for r in records if r["front"]), key=lambda r: r["seconds"])
    axes.step([r["seconds"] for r in front], [100 * r["rmse"] for r in front], where="post", color="#999999",
              linewidth=6, alpha=0.35, zorder=1, label="Pareto front")  # fmt: skip
    for k, name in enumerate(names):
        own = sorted((r for r in records if r["contestant"] == name), key=lambda r: r["seconds"])
        color = COLORS[k % len(COLORS)] if k < SHOWN else "#bbbbbb"
        sure = [r for r in own if r["front"] and r["rmse_spread"] is not None]
        axes.plot([r["seconds"] for r in own], [100 * r["rmse"] for r in own], linestyle="none", color=color,
                  marker=MARKERS[k % len(MARKERS)] if k < SHOWN else ".", markersize=6, alpha=0.9, zorder=3,
                  label=name if k < SHOWN else f"{len(names) - SHOWN} others" if k == SHOWN else None)  # fmt: skip
        axes.errorbar([r["seconds"] for r in sure], [100 * r["rmse"] for r in sure],
                      xerr=[r["seconds_spread"] for r in sure], yerr=[100 * r["rmse_spread"] for r in sure],
                      fmt="none", ecolor="black", elinewidth=1, capsize=2, zorder=4)  # fmt: skip
    if hollow := [r for r in records if not r["built"]]:
        axes.plot([r["seconds"] for r in hollow], [100 * r["rmse"] for r in hollow], "o", markerfacecolor="white",
                  markeredgecolor="#777777", markersize=3.5, zorder=6, label="white: time predicted")  # fmt: skip
    for r in records:
        if r["default"]:
            axes.scatter(r["seconds"], 100 * r["rmse"], s=170, facecolor="none", edgecolor="black", linewidth=1.3,
                         zorder=5, label="run's default")  # fmt: skip
    axes.margins(0.08)
    axes.set(xscale="log", yscale="log", xlabel="seconds", ylabel="relative RMS error, % of the mean light")
    labelled(axes, front)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter(NullFormatter())
    axes.grid(True, which="both", color="#eeeeee", linewidth=0.8)
    axes.set_axisbelow(True)


def labelled(axes: "Axes", front: Sequence[dict[str, Any]]) -> None:
    """Label the front's points with nodes x paths, below, or above where another label is in the way."""
    axes.autoscale_view()
    last, taken = "", [(float("-inf"), 0.0)]
    for r in front:
        name = f"{r['grid']} x {r['paths']}"
        if name == last:
            continue
        last = name
        point = r["seconds"], 100 * r["rmse"]
        x, y = axes.transData.transform(point)
        free = all(abs(x - a) > LABEL[0] or abs(y - b) > LABEL[1] for a, b in taken)
        taken.append((x, y) if free else (x + LABEL[0], y + LABEL[1]))
        axes.annotate(name, point, xytext=(-4, -5) if free else (4, 5), fontsize=7, textcoords="offset points",
                      ha="right" if free else "left", va="top" if free else "bottom", color="#444444",
                      zorder=5)  # fmt: skip


def parts(axes: "Axes", shares: Sequence[dict[str, Any]]) -> None:
    """Mean squared error in parts, stacked so that a bar is as high as the root of their sum; a tick is the total."""
    place: list[float] = []
    base = [0.0] * len(shares)
    for share, before in zip(shares, [None, *shares]):
        same = before is None or share["nodes"] == before["nodes"]
        place.append((place[-1] if place else 0.0) + (1.0 if same else 1.7))
    for part, (name, color) in PARTS.items():
        heights = []
        for share in shares:
            squares = {p: max(0.0, share[p]) for p in PARTS}
            whole = sum(squares.values())
            heights.append(100 * squares[part] / whole**0.5 if whole > 0 else 0.0)
        axes.bar(place, heights, bottom=base, width=0.85, color=color, label=name)
        base = [b + h for b, h in zip(base, heights)]
    total = [100 * share["total"] ** 0.5 for share in shares]
    reach = [
        [t - 100 * max(0.0, share["total"] - share["uncertain"]) ** 0.5 for t, share in zip(total, shares)],
        [100 * (share["total"] + share["uncertain"]) ** 0.5 - t for t, share in zip(total, shares)],
    ]
    axes.errorbar(place, total, yerr=reach, fmt="_", markersize=15, color="black", elinewidth=1, capsize=2,
                  label="total, against the reference")  # fmt: skip
    axes.set_ylim(0, 1.25 * max([*base, *(t + up for t, up in zip(total, reach[1])), 1e-9]))
    axes.set_xticks(place, [f"{share['paths']}" for share in shares], fontsize=8)
    for nodes in sorted({share["nodes"] for share in shares}):
        own = [x for x, share in zip(place, shares) if share["nodes"] == nodes]
        axes.annotate(f"{nodes} nodes", (sum(own) / len(own), 0), xycoords=("data", "axes fraction"), xytext=(0, -20),
                      textcoords="offset points", ha="center", va="top", fontsize=9)  # fmt: skip
    axes.set_xlabel("paths, and nodes along the longest axis", labelpad=20)
    axes.set_ylabel("relative RMS error, %")
    axes.set_title("Where the error of direct + nearest comes from", fontsize=10)
    axes.legend(fontsize=8, ncols=2, loc="upper center")


def image(figure: "Figure", kind: str) -> bytes:
    """The figure as "png" or "svg"."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=kind, dpi=110)
    return buffer.getvalue()
