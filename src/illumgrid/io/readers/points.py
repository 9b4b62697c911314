"""Lists of points: tables of text, .npy, .xyz, and PDB and mmCIF through gemmi.

gemmi (MPL-2.0, 3 MB, no dependencies) reads both forms of the Protein Data Bank. ASE, as large, reads no mmCIF of
macromolecules; MDAnalysis reads it through gemmi, too, and brings ten more packages. XYZ takes no library.
"""

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.errors import BadInput, tell
from illumgrid.field.volume import Floats
from illumgrid.io.readers import named
from illumgrid.io.readers.arrays import header
from illumgrid.io.readers.limits import check_memory, check_size
from illumgrid.io.readers.source import Source, find_source, finish, opened, read_array, seekable

EXPECTED = "expected points as .csv, .txt, .npy, .xyz, .pdb or .cif"
XYZ = ("x", "y", "z")
_UNPACKED = 4  # bytes in memory for a byte of text: the text and its numbers


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points (n, 3), their weights (n,), and the periodic cell and unit of length of the file."""

    points: Floats
    weights: Floats | None = None
    cell: Floats | None = None
    """(3, 3): its edges, row by row."""
    unit: str | None = None

    def periodic(self) -> list[float] | Floats:
        """The cell: its three lengths where its edges lie along the axes of the world, or its edges (3, 3)."""
        if self.cell is None or not self.cell.any():
            raise BadInput("the file of the points has no periodic cell; expected one; give three lengths")
        sides = np.diag(self.cell)
        upright = np.abs(self.cell - np.diag(sides)).max() <= 1e-4 * np.abs(sides).max()
        return [float(side) for side in sides] if upright else self.cell


def read_points(
    path: str | os.PathLike[str], *, weights: str | None = None, columns: Sequence[str] | None = None
) -> Cloud:
    """Read points from a file.

    Parameters
    ----------
    path : str or path-like
        A table of text (`.csv`, `.txt`...: numbers separated by commas, semicolons, tabs or blanks, with or without a
        line of names), `.npy` ((n, k) numbers, or a structured array), `.xyz` (also extended), `.pdb` or `.cif`
        (mmCIF), each also gzipped.
    weights : str, optional
        Column of the weights: a name, or a number from 0. Of atoms also `mass` and `number` (atomic); of PDB and mmCIF
        `occupancy` (the default: alternate places of an atom then count once) and `b_factor`.
    columns : (3,) sequence of str, optional
        Columns of x, y, z; by default those of these names, or else the first three.

    Raises
    ------
    BadInput
        If there is no such file or column, or it was not understood; the sentence begins with the file's name.
    """
    file = Path(os.path.abspath(path))
    with named(file, EXPECTED):
        if not file.is_file():
            what = "a folder" if file.is_dir() else "there is no such file"
            raise BadInput(f"{what}; {EXPECTED}; check the path")
        source = find_source(file)
        if source.size == 0:
            raise BadInput(f"the file is empty; {EXPECTED}; copy or write it again")
        return _reader(source)(source, weights, tuple(columns) if columns else None)


Reader = Callable[[Source, str | None, tuple[str, ...] | None], Cloud]


def _reader(source: Source) -> Reader:
    if source.head.startswith(b"\x93NUMPY"):
        return _read_npy
    if source.ending in (".xyz", ".extxyz"):
        return _read_xyz
    if source.ending in (".pdb", ".ent", ".cif", ".mmcif"):
        return _read_structure
    if b"\0" in source.head:
        raise BadInput(f"holds bytes that are not text; {EXPECTED}; save it as one of those")
    return _read_table


def _pick(column: str, names: Sequence[str]) -> int:
    """Number of a column, by name (whose case does not count) or by number from 0."""
    known = [name.lower() for name in names]
    if known.count(column.lower()) == 1:
        return known.index(column.lower())
    if column.isdecimal() and int(column) < len(names):
        return int(column)
    listed = ", ".join(names[:12]) + (f"… ({len(names)})" if len(names) > 12 else "")
    raise BadInput(f"has no column {column!r}; expected one of {listed}, or a number from 0 to {len(names) - 1}")


def _chosen(names: Sequence[str], weights: str | None, columns: tuple[str, ...] | None) -> list[int]:
    """Numbers of the columns x, y, z, and of the weights where they are wanted."""
    if columns is None:
        columns = XYZ if {*XYZ} <= {name.lower() for name in names} else ("0", "1", "2")
    if len(columns) != 3:
        raise BadInput(f"columns are {', '.join(columns)}; expected three, of x, y and z")
    if len(names) < 3:
        raise BadInput(f"has {len(names)} columns; expected at least three, x, y and z")
    return [_pick(column, names) for column in (*columns, *([] if weights is None else [weights]))]


def _cloud(table: NDArray[Any], **more: Any) -> Cloud:
    """From the chosen columns (n, 3 or 4)."""
    return Cloud(
        np.ascontiguousarray(table[:, :3], float), table[:, 3].astype(float) if table.shape[1] > 3 else None, **more
    )


def _read_npy(source: Source, weights: str | None, columns: tuple[str, ...] | None) -> Cloud:
    with opened(source) as stream:
        shape, fortran, dtype, start = header(stream)
        kinds = [dtype.fields[name][0].kind for name in dtype.names] if dtype.names and dtype.fields else [dtype.kind]
        if len(shape) != (1 if dtype.names else 2) or not all(kind in "iuf" for kind in kinds):
            raise BadInput(f"holds {dtype} of shape {shape}; expected (n, 3) numbers, or a structured array of numbers")
        size = int(np.prod([float(n) for n in shape])) * dtype.itemsize
        check_size(start + size, source.most, 2 * size)
        table = read_array(stream, dtype, shape, "F" if fortran else "C")
        finish(stream, spare=0)
    if dtype.names:
        picked = _chosen(dtype.names, weights, columns)
        return _cloud(np.stack([table[dtype.names[number]] for number in picked], axis=1))
    names = [*XYZ, *map(str, range(3, shape[1]))] if shape[1] >= 3 else ["0"] * shape[1]
    return _cloud(table[:, _chosen(names, weights, columns)])


def _read_table(source: Source, weights: str | None, columns: tuple[str, ...] | None) -> Cloud:
    check_memory(_UNPACKED * source.size)
    with opened(source) as stream:
        skipped, line = 0, ""
        while not line.strip("# \t\r\n"):
            raw = stream.readline(1 << 16)
            if not raw:
                raise BadInput(f"holds no numbers; {EXPECTED}")
            line, skipped = raw.decode("utf-8-sig"), skipped + 1
    delimiter = next((mark for mark in (",", ";", "\t") if mark in line), None)
    words = [word.strip(" \t\r\n\"'") for word in line.lstrip("# \t").rstrip("\r\n").split(delimiter)]
    named_columns = not all(map(_is_number, words))
    names = words if named_columns else [*XYZ, *map(str, range(3, len(words)))][: len(words)]
    picked = _chosen(names, weights, columns)
    with opened(source) as stream:
        rows = skipped if named_columns else skipped - 1
        return _cloud(np.loadtxt(stream, delimiter=delimiter, skiprows=rows, usecols=picked, ndmin=2))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _read_xyz(source: Source, weights: str | None, columns: tuple[str, ...] | None) -> Cloud:
    """A number of atoms, a line of comment (which may say cell and columns), and a line for each atom."""
    check_memory(_UNPACKED * source.size)
    with opened(source) as stream:
        first, comment = _line(stream), _line(stream)
        if not first.strip().isdecimal() or not int(first):
            raise BadInput(f"begins with {first.strip()[:40]!r}; expected the number of atoms, as in the XYZ format")
        count = int(first)
        found = re.search(r'Properties="?([^\s"]+)', comment)
        names = _properties(found[1]) if found else ["species", *XYZ]
        start = stream.readline(1 << 16)
        width = len(start.split())
        names = [*names, *map(str, range(len(names), width))]
        atomic = weights in ("mass", "number") and weights not in names
        picked = _chosen(names, None if atomic else weights, columns)
        if count * 6 > source.most:
            raise BadInput(f"says {count} atoms, for which it is too short; expected a whole file; write it again")
        lines = [start, *(stream.readline(1 << 16) for _ in range(count - 1))]
        if stream.readline(1 << 16).strip():
            note = f"{source.name}: holds several frames, of which the first was read"
            tell("choice", note, stacklevel=4)
    table = np.loadtxt(lines, usecols=picked, ndmin=2, comments=None)
    if len(table) != count:
        raise BadInput(f"says {count} atoms and has {len(table)}; expected a whole file; copy or write it again")
    if atomic:
        which = _pick("species", names) if "species" in names else 0
        kinds = [line.split()[which].decode() for line in lines]
        table = np.column_stack([table, [_of_element(kind, str(weights)) for kind in kinds]])
    lattice = re.search(r'Lattice="([^"]+)"', comment)
    cell = np.array(lattice[1].split(), float).reshape(3, 3) if lattice else None
    return _cloud(table, cell=cell, unit="Å")


def _line(stream: IO[bytes]) -> str:
    return stream.readline(1 << 16).decode("utf-8", "replace")


def _properties(text: str) -> list[str]:
    """Columns of extended XYZ: name:type:count triples; ``pos:R:3`` are x, y, z."""
    parts = text.split(":")
    names = []
    for name, count in zip(parts[::3], parts[2::3]):
        several = [*XYZ] if name == "pos" else [f"{name}{k}" for k in range(int(count))]
        names += several if int(count) > 1 else [name]
    return names


def _of_element(symbol: str, what: str) -> float:
    element = _gemmi().Element(symbol)
    if not element.atomic_number:
        raise BadInput(f"has an atom of the element {symbol!r}; expected chemical symbols for the weight {what!r}")
    return float(element.weight if what == "mass" else element.atomic_number)


def _gemmi() -> Any:
    try:
        import gemmi
    except ImportError:
        raise BadInput(
            "is read by the package gemmi, which is not installed; expected it to be installed; run "
            "pip install 'illumgrid[atoms]'"
        ) from None
    return gemmi


_OF_ATOMS: dict[str, Callable[[Any], float]] = {
    "occupancy": lambda atom: atom.occ,
    "b_factor": lambda atom: atom.b_iso,
    "mass": lambda atom: atom.occ * atom.element.weight,
    "number": lambda atom: atom.occ * atom.element.atomic_number,
}


def _read_structure(source: Source, weights: str | None, columns: tuple[str, ...] | None) -> Cloud:
    """The atoms of the first model."""
    gemmi = _gemmi()
    if columns is not None:
        raise BadInput("columns came with a file of atoms, which has x, y and z; leave them out")
    wanted = weights or "occupancy"
    if wanted not in _OF_ATOMS:
        raise BadInput(f"has no column {wanted!r}; expected one of {', '.join(_OF_ATOMS)}")
    check_memory(_UNPACKED * 4 * source.size)
    with seekable(source) as stream:
        text = stream.read().decode("utf-8", "replace")
    form = gemmi.CoorFormat.Pdb if source.ending in (".pdb", ".ent") else gemmi.CoorFormat.Mmcif
    structure = gemmi.read_structure_string(text, format=form)
    atoms = [atom for chain in structure[0] for residue in chain for atom in residue] if len(structure) else []
    if not atoms:
        raise BadInput(f"holds no atoms; {EXPECTED} of at least one")
    if len(structure) > 1:
        tell("choice", f"{source.name}: holds {len(structure)} models, of which the first was read", stacklevel=4)
    weigh = _OF_ATOMS[wanted]
    cell = structure.cell.orth.mat.array.T if structure.cell.is_crystal() else None
    points = np.array([atom.pos.tolist() for atom in atoms])
    return Cloud(points, np.array([weigh(atom) for atom in atoms]), None if cell is None else np.array(cell), "Å")
