"""Errors and warnings, each in one sentence: what was given, what was expected, what to do."""

import math
import warnings
from collections.abc import Iterable


class BadInput(ValueError):
    """The input cannot be used; the message states what was given, what was expected and what to do."""


class IllumgridWarning(UserWarning):
    """The result is valid, with a limitation that the message states.

    The message begins with the warning's name and a colon: ``warnings.filterwarnings("ignore", "plateau:")`` switches
    one off by name, as ``--ignore plateau`` does on the command line.
    """


WARNINGS = {
    "finite": "voxels that are NaN or infinite were replaced",
    "spacing": "distances between voxels that a file does not say, or that are doubtful",
    "placement": "an orientation that was assumed, rounded, or resampled onto right angles",
    "file": "something in a file that was assumed, or is lost",
    "dicom": "a DICOM series with slices that are missing, unevenly spaced, tilted or left out",
    "choice": "a file with several arrays, of which the marked one was read",
    "compiler": "compiled code that cannot be kept on the disk, or cannot be read from there",
    "plugin": "a plugin that does not load, or two that claim one name",
    "labels": "a volume that looks like a map of labels and is lit as a field",
    "plateau": "the range holds a value on which the field is flat",
    "noise": "normals that turn from voxel to voxel, and that a blur would calm",
    "thin": "parts of the solid thinner than two nodes of the grid",
    "border": "a solid that reaches the border of the volume",
    "empty": "isovalues of the range that have no surface",
    "anisotropy": "voxels much longer along one axis than along another",
    "clip": "a clip plane that leaves nothing out",
    "range": "a range that goes beyond the data",
    "plan": "a time that is too short for the scene, or an error that is out of reach or takes minutes",
    "dark": "a scene without any light",
    "error": "a finished run whose error could not be measured",
    "grid": "light that the grid cannot hold between its nodes, whatever the paths",
    "holes": "nodes within the range that got no light of their own",
}
"""Names of all warnings, and what each is about."""


def shown(number: float, among: Iterable[float] = (), digits: int = 4) -> str:
    """A number as text, with enough digits to distinguish it from those `among` which it is shown.

    101325 among 101320 and 101330 takes seven: a hundredth of what they span.
    """
    all_of = [float(x) for x in (number, *among) if math.isfinite(x)]
    largest, span = max(map(abs, all_of), default=0.0), max(all_of, default=0.0) - min(all_of, default=0.0)
    if 0 < span < math.inf and largest / span > 1:
        digits = max(digits, min(17, math.ceil(math.log10(largest / span)) + 2))
    return f"{number:.{digits}g}"


def shown_range(ends: Iterable[float], digits: int = 4) -> str:
    """Two numbers as text, "LOW to HIGH", with enough digits to differ."""
    low, high = ends
    return f"{shown(low, (high,), digits)} to {shown(high, (low,), digits)}"


def tell(name: str, sentence: str, stacklevel: int = 1) -> None:
    """Warn under one of the names in `WARNINGS`; `stacklevel` counts from the caller."""
    assert name in WARNINGS
    warnings.warn(f"{name}: {sentence}", IllumgridWarning, stacklevel=stacklevel + 1)


def tell_after(name: str, sentence: str, stacklevel: int = 1) -> None:
    """As `tell`, about a finished result: it only prints if warnings are errors, so that the result is kept."""
    try:
        tell(name, sentence, stacklevel + 1)
    except IllumgridWarning:
        with warnings.catch_warnings():
            warnings.simplefilter("always", IllumgridWarning)
            tell(name, sentence, stacklevel + 1)
