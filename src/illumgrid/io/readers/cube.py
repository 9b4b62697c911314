"""Gaussian cube files (`.cube`): a strict reader of our own.

The format is a head of a few lines and a list of numbers; ASE and GridDataFormats, which read it too, bring hundreds of
thousands of lines for that and do not say where a file ends too early. https://gaussian.com/cubegen/
"""

import math
from typing import IO

import numpy as np

from illumgrid.errors import BadInput
from illumgrid.io.readers.limits import AS_FLOAT, check_axes, check_memory, check_size
from illumgrid.io.readers.source import AGAIN, Source, finish, opened, read_text
from illumgrid.io.readers.stored import Stored, Wanted, following, pick

BOHR = "bohr"


def read(source: Source, wanted: Wanted) -> Stored:
    """Read one field of a cube file: a density, a potential, or one of its orbitals."""
    with opened(source) as stream:
        for _ in range(2):
            _line(stream)
        atoms, *origin, fields = _numbers(_line(stream), 4, 5)
        rows = [_numbers(_line(stream), 4, 4) for _ in range(3)]
        shape = tuple(int(row[0]) for row in rows)
        check_axes([abs(n) for n in shape])
        # Negative counts mean that lengths are in angstrom.
        unit = "Å" if shape[0] < 0 else BOHR
        shape = tuple(abs(n) for n in shape)
        if abs(atoms) > 1e6 or not 1 <= fields <= 1000:
            raise BadInput(f"says that it has {atoms:g} atoms and {fields:g} fields; expected a cube file; {AGAIN}")
        for _ in range(int(abs(atoms))):
            _numbers(_line(stream), 5, 5)
        names = [""] * int(fields)
        if atoms < 0:  # orbitals: how many, and their numbers, on one line or more
            words = _line(stream).split()
            count = int(_numbers(" ".join(words[:1]), 1, 1)[0])
            while len(words) < count + 1 <= 1001:
                words += _line(stream).split()
            if not 1 <= count <= 1000 or len(words) != count + 1:
                raise BadInput(f"says that it has {words[0][:20]} orbitals and names {len(words) - 1}; {AGAIN}")
            names = [f"orbital {word[:20]}" for word in words[1:]]
        chosen = pick(wanted.array, "array", names)
        total = math.prod(shape) * len(names)
        check_size(total * 2, source.most, 0)  # a number and a space take two bytes at least
        check_memory(total * (8 + AS_FLOAT))
        flat, behind = read_text(stream, total)
        values = flat.reshape(*shape, len(names))[..., chosen]
        more = finish(stream, behind=behind)
    notes = following(more)
    return Stored(values, np.array(origin), np.array([row[1:] for row in rows]).T, unit=unit, notes=notes)


def _line(stream: IO[bytes]) -> str:
    line = stream.readline(4096)
    if not line:
        raise BadInput(f"ends within its head; {AGAIN}")
    if not line.endswith(b"\n"):
        raise BadInput(f"has a line of more than 4096 characters; expected the head of a cube file; {AGAIN}")
    return line.decode("utf-8", "replace").strip()


def _numbers(line: str, least: int, most: int) -> list[float]:
    words = line.split()[:most]
    try:
        found = [float(word) for word in words]
    except ValueError:
        found = []
    if len(found) < least or not np.isfinite(found).all():
        raise BadInput(f"has the line {line[:60]!r} in its head; expected {least} numbers; {AGAIN}")
    return found + [1.0] * (most - len(found))
