"""The interactive page: isosurfaces marched in the browser's graphics card, lit by the grid; see `page`.

Its source lies in the folder ``page``: JavaScript modules, shaders, one style sheet, put together here as they are.
"""

import base64
import gzip
import hashlib
import html
import json
import re
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from illumgrid.light import Illumination

if TYPE_CHECKING:
    from illumgrid.show.tints import Tint
    from illumgrid.show.viewer.texture import Coming

MODULES = (
    "numbers",
    "coarse",
    "camera",
    "state",
    "sweeps",
    "lights",
    "skies",
    "input",
    "programs",
    "mixture",
    "picture",
    "resting",
    "live",
    "view",
)  # each file imports only from earlier ones
SHADERS = (
    "shared.glsl", "ray.vert", "march.glsl", "field.frag", "wall.vert", "wall.frag", "copy.frag", "mix.frag",
    "origin.frag", "origin_wall.frag", "gather.glsl", "gather_sky.frag", "gather.frag", "gather_wall.frag",
    "blend.frag", "rest.frag",
)  # fmt: skip


@cache
def source(name: str) -> str:
    """Text of one file of the page's source."""
    return (files("illumgrid.show.viewer") / "page" / name).read_text(encoding="utf-8")


def script(last: str, live: bool = False) -> str:
    """The modules and `last` joined into one script: names are unique, so imports, exports and comments are dropped.

    Code for light that is still being computed is in `live` pages only.
    """
    names = [name for name in MODULES if live or name not in ("coarse", "live")]
    joined = "\n".join(source(f"{name}.js") for name in (*names, last))
    joined = re.sub(r"^(import | *//).*\n", "", joined, flags=re.MULTILINE)
    return re.sub(r"^export (?!default)", "", joined, flags=re.MULTILINE)


def shaders() -> dict[str, str]:
    """The shaders by file name, without comments and indentation."""
    return {name: re.sub(r"^ +|^ *//.*\n| *//.*$", "", source(name), flags=re.MULTILINE) for name in SHADERS}


def compressed(data: bytes, level: int = 6) -> bytes:
    """The arrays in gzip, which the page unpacks; equal data give equal bytes."""
    return gzip.compress(data, level, mtime=0)


def _json(value: Any) -> str:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def policy(text: str, live: bool = False) -> str:
    """The content security policy of the page: this one script, pictures that it drew; no network, frames or forms.

    A page that is `live` may also ask the server that it came from.
    """
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    allowed = f"script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data: blob:"
    allowed += "; connect-src 'self'" if live else ""
    return f"default-src 'none'; {allowed}; base-uri 'none'; form-action 'none'"


def page(light: Illumination, up: str | None = None, tint: "Tint | None" = None, coming: "Coming | None" = None) -> str:
    """One HTML file that contains everything: it opens from disk and makes no network request.

    Parameters
    ----------
    light : Illumination
    up : str, optional
        World direction that is up, as in `illumgrid.show.fit_camera`.
    tint : Tint, optional
        A second quantity that colours all fields.
    coming : Coming, optional
        For light that is still coarse: the page then requests the rest from the server that it came from.

    Returns
    -------
    str
        The file's text; about the size of the gzipped field and grid, times 4/3, and 95 KB.
    """
    from illumgrid.show.viewer.packing import packed

    scene, data = packed(light, up, tint, coming)
    live = coming is not None
    parts = {
        "title": html.escape(scene["title"]) + " · illumgrid",
        "style": source("view.css"),
        "markup": source("view.html"),
        "shaders": _json(shaders()),
        "scene": _json(scene),
        "data": base64.b64encode(compressed(data, 1 if live else 6)).decode(),
        "script": script("page", live),
    }
    parts["policy"] = policy(f"\n{parts['script']}\n", live)
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], source("page.html"))
