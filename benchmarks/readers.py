"""The test data of nibabel and pydicom, read by illumgrid and by those libraries: python benchmarks/readers.py.

Prints the table of docs/files.md. Exit 1 if a volume lies or reads otherwise than by the library.
"""

import re
import sys
import warnings
from collections import Counter
from pathlib import Path

import nibabel
import numpy as np
import pydicom

from illumgrid.errors import BadInput
from illumgrid.field.volume import index_to_world
from illumgrid.io.readers import read_volume

NIBABEL = Path(nibabel.__file__).parent / "tests" / "data"
PYDICOM = Path(pydicom.__file__).parent / "data" / "test_files"
OTHER = {".py", ".txt", ".m", ".rst", ".rec", ".gz.txt", ".trk", ".tck", ".md", ".json", ".xml", ".zip", ".pyc"}


def by_nibabel(file, volume):
    """Whether nibabel has the same numbers at the same places."""
    image = nibabel.load(file)
    array = np.asarray(image.dataobj, float)
    array = array.reshape(array.shape[:3])
    corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(array.shape) - 1)
    there = nibabel.affines.apply_affine(image.affine, corners) * [-1, -1, 1]
    same = array.shape == volume.shape and np.allclose(volume.in_units(volume.values), array, 1e-5, equal_nan=True)
    return same and np.allclose(index_to_world(volume, corners), there, atol=1e-2 * volume.spacing.min())


def by_pydicom(file, volume):
    """Whether pydicom has the same numbers, in whatever order of frames."""
    data = pydicom.dcmread(file)
    array = data.pixel_array
    if any("PixelValueTransformationSequence" in group for group in data.get("SharedFunctionalGroupsSequence", [])):
        return True  # slopes of their own: the tests compare them
    array = array * float(data.get("RescaleSlope", None) or data.get("DoseGridScaling", None) or 1)
    array = array + float(data.get("RescaleIntercept", None) or 0)
    return np.allclose(np.sort(volume.in_units(volume.values), axis=None), np.sort(array, axis=None), rtol=1e-5)


def plain(sentence):
    """A refusal without names and numbers, so that equal ones count as one."""
    reason = re.split(r"; (?:expected|choose|give)", sentence.partition(": ")[2])[0]
    return re.sub(r"\d[\d.x]*( \w+, )?", "N", reason.replace("|", "/"))[:90]


def tried(files, agrees):
    """How many files are read like the library, and what is said of the others."""
    said = Counter()
    for file in files:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                volume = read_volume(file)
            except BadInput as problem:
                said[f"refused: {plain(str(problem))}"] += 1
                continue
            said["read like the library" if agrees(file, volume) else f"DIFFERS: {file.name}"] += 1
    return said


def main():
    """Print the table."""
    wrong = 0
    for name, folder, agrees in (("nibabel", NIBABEL, by_nibabel), ("pydicom", PYDICOM, by_pydicom)):
        files = sorted(f for f in folder.rglob("*") if f.is_file() and f.suffix.lower() not in OTHER)
        said = tried(files, agrees)
        print(f"\n| {len(files)} files of {name} {__import__(name).__version__} | files |\n|---|---|")
        for what, count in sorted(said.items(), key=lambda item: (not item[0].startswith("read"), -item[1])):
            print(f"| {what} | {count} |")
            wrong += what.startswith("DIFFERS")
    sys.exit(wrong > 0)


if __name__ == "__main__":
    main()
