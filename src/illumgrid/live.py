"""Light that is shown while it is computed: coarse everywhere at first, then refined where the page looks.

`Live` stands between a run and its keeper: it chooses the next piece of work by what the page shows, and holds the
finished light as textures, whose news the page requests. A node without light of its own has that of the coarse lattice
of every fourth node, which is lit first.
"""

import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput
from illumgrid.field.scene import Levels, Scene
from illumgrid.field.volume import Floats, interpolate, world_to_index
from illumgrid.grid import GREY, RGB, GridSpec, WallTexture, channels_of
from illumgrid.light import Illumination
from illumgrid.show.viewer.arrays import HOLE
from illumgrid.show.viewer.packing import MOST_NODES, Stage
from illumgrid.show.viewer.texture import SIDE, STEP, Coming, Texture
from illumgrid.transport.samples import Queries, Samples
from illumgrid.transport.walk import Answer, Chooser

MOST = 1 << 24
"""Bytes of one answer to the page, in boxes that each hold one texture's share of a piece."""
_APART = np.array([1e3, 1.0, 1.0])
"""Between rows and texels of a wall, for the distance to what is lit: a row shows its own light."""
OUTSIDE, BEHIND = 0.25, 0.05
"""Of a whole sweep: how much later blocks out of view, and in view behind others, come."""


class Stopped(Exception):
    """Nobody looks any more."""


@dataclass(frozen=True)
class Attention:
    """What the page shows: a position of the sweep, and an eye and its direction in the coordinates of the stage."""

    sweep: float = 0.5
    eye: Floats | None = None
    forward: Floats | None = None
    slope: float = 1.0

    @classmethod
    def of(cls, asked: Mapping[str, Sequence[str]]) -> "Attention":
        """From the query of an address; what is not understood is ignored."""
        try:
            numbers = {key: np.array(asked[key][0].split(","), float) for key in ("sweep", "eye", "forward", "slope")}
        except (KeyError, ValueError):
            return cls()
        shapes = [n.shape for n in numbers.values()]
        if shapes != [(1,), (3,), (3,), (1,)] or not all(np.isfinite(n).all() for n in numbers.values()):
            return cls()
        sweep, eye, forward, slope = numbers.values()
        return cls(float(sweep[0]), eye, forward, float(slope[0]))

    def delay(self, low: Floats, high: Floats, middle: Floats) -> Floats:
        """How late blocks (n,) come, of the sweep from `low` to `high` and around `middle` (n, 3); NaN: always seen."""
        late = np.maximum(0.0, np.maximum(low - self.sweep, self.sweep - high))
        if self.eye is None or self.forward is None:
            return late
        away = middle - self.eye
        depth = away @ self.forward
        aside = np.linalg.norm(away - depth[:, None] * self.forward, axis=1)
        hidden = np.where(np.isnan(depth), False, aside > 1.2 * self.slope * depth)
        behind = np.clip((np.nan_to_num(depth, nan=0.0)) / max(float(np.nanmax(np.r_[depth, 1e-9])), 1e-9), 0, 1)
        return np.asarray(late + OUTSIDE * hidden + BEHIND * behind)


@dataclass(eq=False)
class _Places:
    """Where the light of each row goes, and whether the row belongs to the coarse lattice."""

    target: NDArray[np.int32]
    texture: NDArray[np.int64]  # number of its texture, -1 if it is not shown before the end
    flat: NDArray[np.int64]
    first: NDArray[np.bool_]


@dataclass(eq=False)
class _Blocks:
    """What determines when a row is lit, once the coarse lattice is lit."""

    block: NDArray[np.int64]  # of each row
    low: Floats  # of each block: the part of the sweep in which it is visible
    high: Floats
    middle: Floats


@dataclass(eq=False)
class Live:
    """Light as it comes in: a keeper that chooses the next piece, and answers the page.

    Parameters
    ----------
    keeper : RunKeeper
        Keeps what comes in.
    scene : Scene
    specs : sequence of GridSpec
        As the run has them.
    levels : Levels
        Rows of the walls.
    about : dict
        Where the scene comes from, for the recipe of a run that is gone on with by its folder.
    """

    keeper: Any
    scene: Scene
    specs: Sequence[GridSpec]
    levels: Levels
    about: dict[str, Any]
    at_once: bool = True
    attention: Attention = field(default_factory=Attention)
    coarse: threading.Event = field(default_factory=threading.Event)
    """Set when there is light everywhere."""
    stop: threading.Event = field(default_factory=threading.Event)
    """To be set when nobody looks on any more."""
    ended: bool = False
    """Whether all light is there."""
    done: bool = False
    """Whether it is saved, too."""

    def __post_init__(self) -> None:
        if any(np.prod(spec.shape) > MOST_NODES for spec in self.specs):
            raise BadInput(f"a page holds {MOST_NODES} nodes at most while they are lit; choose a smaller --grid")
        self.chosen: dict[str, Any] | None = self.keeper.chosen
        own = channels_of(self.scene).own
        self._shapes = [spec.shape for spec in self.specs]
        self._shapes += [(len(self.levels.table), *quad.texels[::-1]) for quad in self.scene.quads]
        self._textures = [Texture.of(shape, own) for shape in self._shapes]
        self._lock, self._stamp, self._scale = threading.Lock(), 0, 1.0
        self._first, self._filled = 0, False
        self._batches: list[int] = [0]
        self._late: tuple[Attention, Floats] | None = None
        self._places: _Places | None = None
        self._blocks: _Blocks | None = None
        self._left, self._paths = 1, range(0)
        self._waiting: Callable[[], None] | None = None
        self._held: list[tuple[NDArray[np.int64], Answer]] = []

    # --- the keeper of a run -------------------------------------------------------------------------------------

    def choose(self, chosen: dict[str, Any]) -> None:
        """See `RunKeeper`."""
        self.keeper.choose({**chosen, "lazy": self.about})

    def begin(self, targets: Sequence[Queries], order: NDArray[np.int64]) -> Chooser:
        """See `Keeper`.

        Of a run that is new the keeper, which has much to look at, learns after there is light everywhere.
        """
        self._waiting = partial(self.keeper.begin, targets, order)
        if self.chosen:
            self._waiting()
            self._waiting = None
        self._batches = np.cumsum([0, *map(len, targets)]).tolist()
        self._places = self._placed(targets)
        self._lit, self._left = np.zeros(self._batches[-1], bool), self._batches[-1]
        return self.next

    def known(self, paths: range) -> Answer | None:
        """See `Keeper`."""
        self._paths = paths
        found: Answer | None = None if self._waiting else self.keeper.known(paths)
        if found is not None:
            rows = np.flatnonzero(found.paths >= 0)
            self._show(rows, found.light[rows])
        return found

    def keep(self, rows: NDArray[np.int64], answer: Answer) -> None:
        """See `Keeper`."""
        coarse = self.coarse.is_set()
        self._held.append((rows, answer))
        self._show(rows, answer.light)
        if coarse:
            self._hand_on()
            self.keeper.settle()
        if self.stop.is_set():
            raise Stopped

    def _hand_on(self) -> None:
        """Give the keeper the answers that came in."""
        if self._waiting:
            self._waiting()
            self._waiting = None
            self.keeper.known(self._paths)
        while self._held:
            self.keeper.keep(*self._held.pop(0))

    def flush(self) -> None:
        """See `Keeper`."""
        if self.coarse.is_set():
            self._hand_on()
            self.keeper.settle()
        if not self._waiting:
            self.keeper.flush()

    def end(self, answers: Sequence[Samples]) -> None:
        """See `Keeper`."""
        self.ended = True
        self._hand_on()
        self.keeper.end(answers)

    # --- what is next --------------------------------------------------------------------------------------------

    def next(self, unknown: NDArray[np.bool_], most: Sequence[int]) -> tuple[int, NDArray[np.int64]]:
        """The batch of the next piece and its targets: the coarse lattice first, then blocks by `_delays`."""
        rows = np.flatnonzero(unknown)
        first = rows[:0] if self._places is None else rows[self._places.first[rows]]
        late = None if first.size else self._delays()
        rows = first if late is None else rows
        soonest = rows[0] if late is None else rows[late[rows].argmin()]
        number = int(np.searchsorted(self._batches, soonest, side="right")) - 1
        begin, stop = self._batches[number : number + 2]
        own = rows[np.searchsorted(rows, begin) : np.searchsorted(rows, stop)]
        if late is not None and len(own) > most[number]:
            own = np.sort(own[np.argpartition(late[own], most[number])[: most[number]]])
        own = own[: most[number]]
        return number, own - begin

    def _delays(self) -> Floats:
        """For each row, how late it is lit."""
        looked, places = self.attention, self._places
        if places is None:
            raise RuntimeError("nothing was begun")
        if self._blocks is None:
            self._blocks = self._blocked(places)
        if self._late is None or self._late[0] is not looked:
            blocks = self._blocks
            delay = looked.delay(blocks.low, blocks.high, blocks.middle)[blocks.block]
            delay[places.texture < 0] += 10.0  # levels that are held: after everything else
            self._late = looked, delay
        return self._late[1]

    def _placed(self, targets: Sequence[Queries]) -> _Places:
        """Where rows are shown, and which come first. Must be quick, since the first picture waits for it."""
        count = self._batches[-1]
        texture, flat, coarse = np.full(count, -1, np.int64), np.zeros(count, np.int64), np.zeros(count, bool)
        whose = np.concatenate([np.zeros(0, np.int32), *(queries.target for queries in targets)])
        for queries, begin in zip(targets, self._batches):
            for target in np.unique(queries.target).tolist():
                of, shape = np.flatnonzero(queries.target == target), self._shapes[target]
                ids = queries.id[of]
                flat[begin + of] = ids & np.uint64((1 << 40) - 1)  # of `Direct`, and of texels
                held = (ids >> np.uint64(56)) > 0
                texture[begin + of] = np.where(held, -1, target)
                lattice = np.zeros(shape, bool)
                lattice[::STEP, ::STEP, ::STEP] = True
                first = lattice.reshape(-1)[flat[begin + of]]
                first[:: STEP**3] |= not first.any()
                coarse[begin + of] = first & ~held
        return _Places(whose, texture, flat, coarse)

    def _blocked(self, places: _Places) -> _Blocks:
        """The blocks of rows, and where they are visible."""
        stage, fields, rows = Stage.of(self.scene), len(self.specs), len(self.levels.table)
        count, blocks = self._batches[-1], 0
        block = np.full(count, -1, np.int64)
        low, high, middle = np.zeros(count), np.ones(count), np.full((count, 3), np.nan)
        for begin, stop in pairwise(self._batches):
            for target in np.unique(places.target[begin:stop]).tolist():
                of, shape = begin + np.flatnonzero(places.target[begin:stop] == target), self._shapes[target]
                index = np.array(np.unravel_index(places.flat[of], shape))
                if target < fields:
                    level, point = self._seen(target, places.flat[of])
                    low[of] = high[of] = level
                    middle[of] = stage.place(point)
                else:
                    low[of], high[of] = ((index[0] + k) / max(rows - 1, 1) for k in (-1, 1))
                step = (STEP, STEP, STEP) if target < fields else (1, STEP, STEP)
                sizes = [-(-n // s) for n, s in zip(shape, step)]
                block[of] = blocks + np.ravel_multi_index(tuple(i // s for i, s in zip(index, step)), sizes)
                blocks += int(np.prod(sizes))
        return _Blocks(block, *_of_blocks(block, blocks, low, high, middle))

    def _seen(self, number: int, flat: NDArray[np.int64]) -> tuple[Floats, Floats]:
        """Where in the sweep nodes are visible, and their positions; whole queries would take seconds."""
        field, points = self.scene.fields[number], self.specs[number].nodes(flat)
        level = interpolate(field.volume, world_to_index(field.volume, points))
        return field.place(np.clip(level, *field.range)), points

    # --- what is there -------------------------------------------------------------------------------------------

    def _show(self, rows: NDArray[np.int64], light: NDArray[np.float32]) -> None:
        places = self._places
        if places is None:
            return
        with self._lock:
            self._fill()
            self._stamp += 1
            for number in np.unique(places.texture[rows]).tolist():
                if number >= 0:
                    texture, own = self._textures[number], places.texture[rows] == number
                    texture.paint(places.flat[rows[own]], light[own][:, : texture.light.shape[-1]], self._stamp)
            self._lit[rows] = True
            self._left -= len(rows)
            if not self.coarse.is_set() and self._lit[places.first].all():
                self._stamp += 1
                self._first = self._stamp
                for texture in self._textures[len(self.specs) :]:
                    texture.fill(_APART, self._stamp)
                self.coarse.set()

    def _fill(self) -> None:
        """Fill all nodes with coarse light, once; the page, which begins with the coarse nodes, need not wait."""
        if self._filled or not self.coarse.is_set():
            return
        self._filled = True
        for texture, spec in zip(self._textures, self.specs):
            texture.fill(STEP * spec.spacing, self._first)

    @property
    def share(self) -> float:
        """Share of all targets that are lit."""
        return 1 - self._left / max(self._batches[-1], 1)

    def light(self) -> tuple[Illumination, Coming]:
        """The light of the coarse lattice, with which a page begins, and what is to come; errors are not known yet."""
        channels = GREY if channels_of(self.scene).grey else RGB
        with self._lock:
            fields = self._textures[: len(self.specs)]
            grids = tuple(texture.every_fourth(spec, channels) for texture, spec in zip(fields, self.specs))
            beyond = any(t.known.sum() > t.known[::STEP, ::STEP, ::STEP].sum() for t in fields)
            walls = tuple(
                WallTexture(t.light.copy(), t.known.astype(np.float32), channels)
                for t in self._textures[len(self.specs) :]
            )
            shown = Illumination(self.scene, self.levels, grids, walls, {"seed": 0})
            self._scale = shown.exposure / np.pi
            return shown, Coming(1 if beyond else self._stamp, self.specs)  # 1: all boxes are newer

    def news(self, asked: Mapping[str, Sequence[str]]) -> bytes:
        """What changed since the page last asked, which says what it shows: a header in JSON, then half floats.

        The header is preceded by its length in four bytes, the lowest first, and ends at a multiple of four.
        """
        self.attention = Attention.of(asked)
        since = int(asked["since"][0]) if asked.get("since", [""])[0].isdecimal() else 0
        parts: list[dict[str, Any]] = []
        data: list[bytes] = []
        room = MOST
        with self._lock:
            self._fill()
            found = [(int(t.stamps[at]), k, at) for k, t in enumerate(self._textures) for at in _newer(t.stamps, since)]
            found.sort(key=lambda each: each[0])
            upto = self._stamp
            for stamp, number, at in found:
                if room < 0 and stamp > parts[-1]["stamp"]:
                    upto = parts[-1]["stamp"]
                    break
                low, texels = self._box(number, at)
                parts.append({"texture": number, "stamp": stamp, "from": low, "shape": list(texels.shape[2::-1])})
                data.append(texels.tobytes())
                room -= texels.nbytes
            header = {"stamp": upto, "share": self.share, "done": self.done and upto == self._stamp, "parts": parts}
        head = json.dumps(header).encode()
        head += b" " * (-len(head) % 4)
        return b"".join([len(head).to_bytes(4, "little"), head, *data])

    def _box(self, number: int, at: tuple[int, ...]) -> tuple[list[int], NDArray[np.float16]]:
        """A box of a texture as the page has it: where it begins along x, y, z, and texels (z, y, x, C + 1)."""
        texture = self._textures[number]
        box = tuple(slice(SIDE * k, SIDE * k + SIDE) for k in at)
        light = texture.light[box] * self._scale
        texels = np.concatenate([light, np.full((*light.shape[:3], 1), HOLE, np.float32)], axis=3).clip(-65504, 65504)
        low = [SIDE * k for k in at]
        if number < len(self.specs):
            return low, np.ascontiguousarray(texels.transpose(2, 1, 0, 3), np.float16)
        low[2] += sum(quad.texels[0] for quad in self.scene.quads[: number - len(self.specs)])
        return low[::-1], np.ascontiguousarray(texels, np.float16)


def _newer(stamps: NDArray[np.int64], since: int) -> list[tuple[int, ...]]:
    return [tuple(at) for at in np.argwhere(stamps > since).tolist()]


def _of_blocks(
    block: NDArray[np.int64], count: int, low: Floats, high: Floats, middle: Floats
) -> tuple[Floats, Floats, Floats]:
    """Where in the sweep each block of rows is seen, with half a block more on either side, and its middle."""
    least, most, mean = np.full(count, np.inf), np.full(count, -np.inf), np.zeros((count, 3))
    np.minimum.at(least, block, low)
    np.maximum.at(most, block, high)
    many = np.maximum(np.bincount(block, minlength=count), 1)
    for axis in range(3):
        mean[:, axis] = np.bincount(block, middle[:, axis], count) / many
    more = np.where(least <= most, (most - least) / 2, 0.0)
    return least - more, most + more, mean
