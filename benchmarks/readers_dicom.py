"""The test data that come with pydicom, read by illumgrid and by pydicom itself: a table for the docs.

    python benchmarks/readers_dicom.py docs/images/readers_dicom.md

Each file, and each folder of slices, is read with the values that pydicom gives, or refused in a sentence. Exit 1
if a value differs or anything but a sentence comes.
"""

import re
import sys
import warnings
from collections import defaultdict
from pathlib import Path

import numpy as np
import pydicom
import pydicom.data

from illumgrid import BadInput, read_volume

ROOT = Path(pydicom.data.__file__).parent
KINDS = {
    "single DICOM plane": "refused: a single plane, no volume",
    "a single plane": "refused: a single plane, no volume",
    "planes, none of which": "refused: planes that are not parallel",
    "without an image": "refused: a report, plan, contour or waveform, no image",
    "without pixels": "refused: its pixels were taken out",
    "does not say what object": "refused: parts of a data set, for tests of parsers",
    "index of a medium": "refused: DICOMDIR, an index",
    "there is nothing": "refused: slices far from each other",
    "film": "refused: a film of one plane",
    "colours": "refused: colours, of which --channel reads one",
    "palette": "refused: numbers of colours in a palette",
    "neither its first bytes": "refused: no DICOM",
    "is no number": "refused: a number that is none",
    "series: none": "refused: a folder without images",
}


def by_pydicom(place: Path) -> np.ndarray:
    """All values of a file or of the files of a folder, in rising order."""
    values = []
    for file in [place] if place.is_file() else sorted(place.iterdir()):
        data = pydicom.dcmread(file)
        scale = float(data.get("DoseGridScaling", data.get("RescaleSlope", 1)))
        values.append(data.pixel_array.ravel() * scale + float(data.get("RescaleIntercept", 0)))
    return np.sort(np.concatenate(values))


def outcome(place: Path) -> str:
    """What comes of reading, as a row of the table."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            volume = read_volume(place)
        except BadInput as problem:
            said = str(problem).partition(": ")[2]
            return next((row for word, row in KINDS.items() if word in said), f"refused: {said}")
        same = np.allclose(np.sort(volume.values.ravel()), by_pydicom(place), rtol=1e-6)
    return "read, with the values that pydicom gives" if same else "WRONG: other values than pydicom's"


def main() -> None:
    files = [p for p in sorted(ROOT.rglob("*")) if p.is_file() and p.suffix not in (".py", ".pyc", ".json")]
    folders = sorted({p.parent for p in files if "dicomdirtests" in p.parts})
    rows = defaultdict(list)
    for place in [*files, *folders]:
        rows[outcome(place)].append(place.relative_to(ROOT).as_posix() + ("/" if place.is_dir() else ""))
    lines = ["| outcome | files | for example |", "|---|---|---|"]
    for row, places in sorted(rows.items(), key=lambda one: (one[0].startswith("refused"), -len(one[1]))):
        example = re.sub(r"^(test_files|dicomdirtests)/", "", places[0])
        lines.append(f"| {row} | {len(places)} | `{example}` |")
    table = "\n".join(lines) + "\n"
    print(table)
    if len(sys.argv) > 1:
        Path(sys.argv[1]).write_text(table, "utf-8")
    sys.exit(any(not row.startswith(("read", "refused: ")) or row.count(":") > 1 for row in rows))


if __name__ == "__main__":
    main()
