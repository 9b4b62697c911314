"""The test data that come with nibabel, read by illumgrid and by nibabel itself: a table for the docs.

    python benchmarks/readers_nibabel.py docs/images/readers_nibabel.md

Each file is read with nibabel's values at nibabel's places, or refused in a sentence. Exit 1 if anything differs.
"""

import re
import sys
import warnings
from collections import defaultdict
from pathlib import Path

import nibabel
import numpy as np

from illumgrid import BadInput, read_volume
from illumgrid.field.volume import index_to_world

ROOT = Path(nibabel.__file__).parent / "tests" / "data"
OTHER = (".py", ".txt", ".m", ".rst", ".REC", ".BRIK", ".BRIK.gz", ".trk", ".tck", ".pyc")
OBLIQUE = "read; its axes are oblique to each other and were resampled onto right angles"
KINDS = {
    "time steps": "refused with the list of its time steps; the first, chosen by `--time 0`, is read as by nibabel",
    "other half": "refused: a header without its data",
    "(.par)": "refused: PAR/REC",
    "(.head)": "refused: AFNI",
    "HDF5 file that ITK": "refused: MINC 2",
    "NetCDF": "refused: MINC 1",
    "single DICOM plane": "refused: a single plane",
    "neither its first bytes": "refused: no volume",
    "axes": "refused: a matrix, no volume",
}


def as_nibabel(file: Path, time: int | None) -> bool:
    """Whether nibabel has the same values at the same places."""
    volume, image = read_volume(file, time=time), nibabel.load(file)
    array = np.asarray(image.dataobj, float)
    array = array if time is None else array[..., time]
    if array.shape != volume.shape:  # oblique axes: resampled, between the lowest and the highest value
        low, high = volume.extremes
        return bool(array.min() <= low <= high <= array.max())
    corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(array.shape) - 1)
    there = nibabel.affines.apply_affine(image.affine, corners) * [-1, -1, 1]  # RAS to LPS
    return np.allclose(volume.values, array, rtol=1e-6, equal_nan=True) and np.allclose(
        index_to_world(volume, corners), there, atol=1e-3
    )


def outcome(file: Path) -> str:
    """What comes of reading, as a row of the table."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            if not as_nibabel(file, None):
                return f"WRONG: {file.name}"
            return OBLIQUE if read_volume(file).shape != nibabel.load(file).shape else "read as by nibabel"
        except BadInput as problem:
            said = str(problem).partition(": ")[2]
        if "time steps" in said and not as_nibabel(file, 0):
            return f"WRONG: {file.name}"
    return next((row for word, row in KINDS.items() if word in said), f"refused: {said}")


def main() -> None:
    """Print the table, and write it where asked."""
    files = [p for p in sorted(ROOT.iterdir()) if p.is_file() and not p.name.endswith(OTHER) and p.name[0] != "."]
    rows = defaultdict(list)
    for file in files:
        rows[outcome(file)].append(file.name)
    lines = ["| outcome | files | for example |", "|---|---|---|"]
    for row, names in sorted(rows.items(), key=lambda one: (one[0].startswith("refused:"), -len(one[1]))):
        lines.append(f"| {re.sub('[|]', '/', row)} | {len(names)} | `{names[0]}` |")
    table = "\n".join(lines) + "\n"
    print(table)
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(table, "utf-8")
    sys.exit(any(row.startswith("WRONG") for row in rows))


if __name__ == "__main__":
    main()
