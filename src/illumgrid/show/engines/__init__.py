"""Rendering engines: OpenGL where it is available, otherwise the package's own kernels."""

from typing import TYPE_CHECKING

from illumgrid.errors import BadInput
from illumgrid.show.engines import gl

if TYPE_CHECKING:
    from illumgrid.field.scene import Scene

ENGINES = ("auto", "egl", "osmesa", "software")


_LARGE = 1 << 26  # voxels; extraction holds each in single precision, and makes millions of triangles


def too_large_for_meshes(scene: "Scene") -> bool:
    """Whether drawing a scene by rays takes much less memory than by triangles."""
    return sum(field.volume.stored.size for field in scene.fields) > _LARGE


def choose_engine(name: str) -> tuple[str, str]:
    """The engine for a requested name, and the reason for the choice.

    Raises
    ------
    BadInput
        If it is unknown, or not available here.
    """
    if name not in ENGINES:
        raise BadInput(f"the engine is {name!r}; expected one of {', '.join(ENGINES)}")
    if name == "software":
        return name, "as asked"
    reasons = []
    for platform in gl.PACKAGES if name == "auto" else (name,):
        reason = gl.unavailable(platform)
        if reason is None:
            return platform, "as asked" if name == platform else f"OpenGL is available through {platform.upper()}"
        reasons.append(f"no {platform.upper()} ({reason})")
    if name == "auto":
        if gl.elsewhere():
            return "software", f"{gl.elsewhere()}"
        return "software", f"{' and '.join(reasons)}; apt-get install {' '.join(gl.PACKAGES.values())} brings OpenGL"
    if gl.elsewhere():
        raise BadInput(
            f"the engine {name} was requested, but {gl.elsewhere()}; expected all pictures in one thread; draw there "
            "or choose --engine software"
        )
    raise BadInput(
        f"the engine {name} was requested, but there is {reasons[0]}; install it (apt-get install {gl.PACKAGES[name]} "
        "on Debian and Ubuntu) or choose --engine software"
    )
