"""The input of a command: a volume with its surroundings, a scene file or a built-in scene."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from illumgrid.cli.reading import check_inside, given, labels_of
from illumgrid.errors import BadInput

if TYPE_CHECKING:
    from illumgrid.field.builtin import Preset
    from illumgrid.field.scene import Field, Scene
    from illumgrid.field.volume import Side
    from illumgrid.io.elsewhere import Source


AROUND = ("studio", "sky", "floor", "box")
"""Scenes around a volume, by the names of their constructors; the first is the default."""


@dataclass(frozen=True)
class Input:
    """The input of a command: a name for the folder of the result, and a function `make(smooth)` that makes the scene.

    `smooth` is a blur in voxels. `source` is the volume file of the scene, if it has one.
    """

    name: str
    make: Callable[[float], "Scene"]
    preset: "Preset | None" = None
    source: "Callable[[float], Source] | None" = None


def scene_input(
    source: str | None,
    surroundings: str | None,
    limits: tuple[float, float] | None,
    inside: str | None,
    signed: bool,
    albedo: tuple[float, float, float] | None,
    reading: dict[str, Any],
) -> Input:
    """Recognise a volume file, a scene file or a built-in scene; nothing is read yet."""
    from illumgrid.field.builtin import SCENES
    from illumgrid.io.readers import volume_name

    name = "nucleus" if source is None else source
    preset = SCENES.get(name) if source is None or not Path(source).exists() else None
    if preset or name.lower().endswith(".toml"):
        if extra := given(
            scene=surroundings, range=limits, inside=inside, signed=signed or None, albedo=albedo, **reading
        ):
            options = ", ".join(f"--{option}" for option in extra)
            what, todo = ("built-in scene", "leave") if preset else ("scene file", "write them into the file and leave")
            raise BadInput(
                f"{options} came with the {what} {name!r}; expected a volume file with them: {todo} them out"
            )
        return Input(name, partial(_smoothed, preset.make), preset) if preset else _scene_file(name)
    check_inside(inside, reading.get("label"))
    if surroundings not in (None, *AROUND):
        raise BadInput(f"--scene is {surroundings!r}; expected {', '.join(AROUND[:-1])} or {AROUND[-1]}")
    if signed and (also := given(inside=inside, label=reading.get("label"))):
        raise BadInput(
            f"--signed and --{next(iter(also))} came together; expected one of them: --signed lights h >= c and h <= -c"
        )
    side: Side | None = None if signed else "below" if inside == "below" else "above"
    from illumgrid.io.elsewhere import Source

    labels = labels_of(reading.get("label"))
    plain = {key: value for key, value in reading.items() if key != "label"}
    read_as = partial(Source, name, plain, labels, side)
    make = partial(_volume_scene, read_as, surroundings or AROUND[0], albedo, limits)
    return Input(volume_name(name), make, source=read_as)


def _scene_file(name: str) -> Input:
    from illumgrid.io.readers import read_scene

    return Input(Path(name).stem, lambda smooth: read_scene(name, smoothing=smooth))


def _volume_scene(
    read_as: "Callable[[float], Source]", surroundings: str, albedo: Any, limits: Any, smooth: float
) -> "Scene":
    """The fields of a volume with their surroundings; both signs of it if its side is None."""
    import numpy as np

    from illumgrid.field.labels import fields_of
    from illumgrid.field.scene import Material, Scene
    from illumgrid.field.signed import signed_pair
    from illumgrid.io.readers import volume_name

    around: Callable[..., Scene] = getattr(Scene, surroundings)
    source = read_as(smooth)
    name, volumes = volume_name(source.path), source.volumes()
    if source.labels:
        each = {label: volume for label, volume in volumes.items() if label is not None}
        return _around_all(around, fields_of(name, each, albedo, limits))
    if source.side is None:
        material = None if albedo is None else Material(np.asarray(albedo))
        return _around_all(around, signed_pair(name, volumes[None], limits, material))
    return around(volumes[None], albedo, limits, source.side, name)


def _around_all(around: Callable[..., "Scene"], fields: "Sequence[Field]") -> "Scene":
    """Several fields of one lattice with the surroundings that `around` makes for the first."""
    first = fields[0]
    scene = around(first.volume, first.material.albedo, first.range, first.inside, first.name)
    return replace(scene, fields=tuple(fields))


def in_harmonics(scene: "Scene", lights: str | None, degree: int | None) -> "Scene":
    """With `--lights sh`, spherical harmonics in place of the distant lights of the scene."""
    if lights not in (None, "sh"):
        raise BadInput(f"--lights is {lights!r}; expected sh, or leave it out to keep each light of the scene")
    if lights is None and degree is not None:
        raise BadInput("--degree came without --lights sh; expected both")
    return scene if lights is None else scene.in_harmonics(2 if degree is None else degree)


def _smoothed(make: Callable[[], "Scene"], smooth: float) -> "Scene":
    from illumgrid.field.filters import smooth as blur

    scene = make()
    return replace(scene, fields=tuple(replace(f, volume=blur(f.volume, smooth)) for f in scene.fields))
