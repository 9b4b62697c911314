"""Fields of a volume file, as a run uses them; and runs that refer to that file instead of storing them."""

import hashlib
import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from illumgrid.errors import BadInput
from illumgrid.field.filters import finite, smooth
from illumgrid.field.signed import without_gaps
from illumgrid.field.volume import Side, Volume, slabs
from illumgrid.io.readers import read_volume


@dataclass(frozen=True)
class Source:
    """The source of the fields of a run.

    Parameters
    ----------
    path : str
        The volume file or folder.
    reading : mapping
        Arguments of `read_volume`, without the label.
    labels : sequence of int
        One field for each; none: the values of the file.
    side : {"above", "below"} or None
        Which side is solid, which determines how gaps are filled; None for a field of both signs.
    blur : float
        Voxels by which the field was smoothed.
    """

    path: str
    reading: Mapping[str, Any]
    labels: Sequence[int]
    side: Side | None
    blur: float

    def volumes(self, folded: bool = False) -> dict[int | None, Volume]:
        """The volumes by label, or that of the file under None.

        With `folded` in single precision, slope and intercept of the file applied: so they were kept before there was
        `Volume.stored`.
        """
        if self.labels:
            each = {label: read_volume(self.path, **self.reading, label=label) for label in self.labels}
            return {label: smooth(volume, self.blur) for label, volume in each.items()}
        volume = read_volume(self.path, **self.reading)
        if folded:
            place = volume.origin, volume.spacing, volume.direction
            volume = Volume(volume.values.astype(float), *place, unit=volume.unit, oriented=volume.oriented)
        volume = without_gaps(volume) if self.side is None else finite(volume, self.side)
        return {None: smooth(volume, self.blur)}


def digest(volume: Volume) -> str:
    """SHA-256 of the values, their type and their map to units."""
    seen = hashlib.sha256(f"{volume.stored.dtype.name} {volume.shape} {volume.slope!r} {volume.intercept!r}".encode())
    for slab in slabs(volume.shape):
        seen.update(volume.stored[slab].data)
    return seen.hexdigest()


def referred(source: Source, folder: Path) -> dict[str, Any]:
    """The entry for the source of the run at `folder`: its path, also relative to the folder, and how it was read."""
    path = os.path.abspath(source.path)
    near = os.path.relpath(path, folder) if Path(path).anchor == folder.anchor else path
    return asdict(source) | {"path": path, "near": near}


def fields_again(about: Mapping[str, Any], folder: Path, digests: Sequence[str]) -> list[Volume]:
    """The volumes to which a record refers, one for each digest.

    Raises
    ------
    BadInput
        If the source is gone, or does not give the fields that were lit.
    """
    places = [str(about["path"]), os.path.join(folder, str(about["near"]))]
    path = next((place for place in places if os.path.exists(place)), None)
    if path is None:
        raise BadInput(f"its field is in {about['path']} (--no-embed), which is gone; put that file back")
    names = ("spacing", "channel", "time", "array", "crop", "downsample")
    reading = {name: about["reading"][name] for name in names if name in about["reading"]}
    source = Source(path, reading, about["labels"], about["side"], float(about["blur"]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the notes were issued when the run was made, and are in its record
        for folded in (False, True):
            found = list(source.volumes(folded).values())
            found = found if len(found) == len(digests) else found * len(digests)  # both signs of one volume
            if [digest(volume) for volume in found] == list(digests):
                return found
    raise BadInput(f"its field is in {path} (--no-embed), which has changed since it was lit; put the old file back")
