"""Pictures by OpenGL without a screen: pyrender on EGL or OSMesa. The only file that imports it.

pyrender 0.1.45 (2021) pins PyOpenGL 3.1.0; `_import` works around what both lack beside current NumPy and Mesa. A
process keeps the platform and the renderer that it opened first: PyOpenGL chooses its library on import, and under EGL
deleting one renderer destroys the context of every other.
"""

import gc
import os
import sys
import threading
import types
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from illumgrid.field.volume import Floats
from illumgrid.show.camera import Camera
from illumgrid.show.shade import Colors
from illumgrid.show.triangles import Colored
from illumgrid.tone import decode_srgb, encode_rgba, srgb_curve

SIDE = 2  # pixels drawn along each side of one: averaged in linear light, as the software engine does
TILE = 2048  # pixels along a side that are drawn at once: larger framebuffers fail on common drivers
PACKAGES = {"egl": "libegl1 libgl1", "osmesa": "libosmesa6"}
"""Platforms, best first, and the Debian packages that bring their libraries."""

_opened: dict[str, Any] = {}  # at most one: platform to renderer
_home: list[tuple[int, int]] = []  # process and thread that own the context: in another, drawing fails or hangs
_missing: dict[str, str] = {}  # platform to the reason why it cannot be used here


def unavailable(platform: str) -> str | None:
    """Why this platform cannot draw in this process and thread, in a few words; None if it can."""
    if reason := elsewhere():
        return reason
    if platform not in _opened and platform not in _missing:
        reason = _open(platform)
        if reason is not None:
            _missing[platform] = reason
    return None if platform in _opened else _missing[platform]


def elsewhere() -> str | None:
    """Where OpenGL was opened, if not in this thread of this process."""
    if not (_opened and _home) or _home == [(os.getpid(), threading.get_ident())]:
        return None
    where = "thread" if _home[0][0] == os.getpid() else "process, from which this one was forked"
    return f"OpenGL was opened in another {where}"


def _open(platform: str) -> str | None:
    if _opened:
        return f"this process draws by {next(iter(_opened))} already, and one process has one OpenGL"
    if "OpenGL" in sys.modules:
        return "another library of this process uses OpenGL already"
    before = os.environ.get("PYOPENGL_PLATFORM")
    os.environ["PYOPENGL_PLATFORM"] = platform  # read when OpenGL is imported, and when a renderer is made
    reason = None
    try:
        pyrender = _import(platform)
        renderer = pyrender.OffscreenRenderer(64, 64)
        renderer._platform.supports_framebuffers = lambda: True  # otherwise OSMesa keeps the size of the first picture
        _opened[platform] = pyrender, renderer
        _home[:] = [(os.getpid(), threading.get_ident())]
    except Exception as error:  # ImportError, AttributeError, EGLError, AssertionError...
        reason = " ".join(f"{type(error).__name__} {error}".split())[:90]
    finally:
        if before is None:
            del os.environ["PYOPENGL_PLATFORM"]
        else:
            os.environ["PYOPENGL_PLATFORM"] = before
    if reason is not None:
        _forget()
    return reason


def _forget() -> None:
    """Allow the other platform to be tried after this one failed."""
    gc.collect()
    for name in [n for n in sys.modules if n.split(".")[0] in ("OpenGL", "pyrender")]:
        del sys.modules[name]


def _import(platform: str) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not hasattr(np, "infty"):
            setattr(np, "infty", np.inf)  # noqa: B010  (gone since NumPy 2)
        # pyrender imports its window, with it pyglet, and with that desktop libraries: none of them is needed.
        window: Any = types.ModuleType("pyrender.viewer")
        window.Viewer = None
        sys.modules[window.__name__] = window
        try:
            if platform == "osmesa":
                _complete_osmesa()
            import pyrender
        finally:
            del sys.modules[window.__name__]
    return pyrender


def _complete_osmesa() -> None:
    """Add to PyOpenGL 3.1.0 what pyrender needs: contexts of a chosen version, and contexts that can be compared."""
    import ctypes

    import OpenGL.platform
    from OpenGL import osmesa

    library = OpenGL.platform.PLATFORM.OSMesa
    create = library.OSMesaCreateContextAttribs
    create.restype, create.argtypes = osmesa.OSMesaContext, [ctypes.POINTER(ctypes.c_int), osmesa.OSMesaContext]
    numbers = {"FORMAT": 0x22, "RGBA": 0x1908, "DEPTH_BITS": 0x30, "PROFILE": 0x33, "CORE_PROFILE": 0x34}
    for name, number in {**numbers, "CONTEXT_MAJOR_VERSION": 0x36, "CONTEXT_MINOR_VERSION": 0x37}.items():
        setattr(osmesa, f"OSMESA_{name}", number)
    osmesa.OSMesaCreateContextAttribs = create
    current = library.OSMesaGetCurrentContext
    current.restype = ctypes.c_void_p
    OpenGL.platform.PLATFORM.GetCurrentContext = current
    OpenGL.platform.GetCurrentContext = current


def draw(
    parts: list[Colored], camera: Camera, width: int, height: int, background: Colors, platform: str
) -> NDArray[np.uint8]:
    """Picture (height, width, 4), sRGB and coverage, of triangles, in tiles; `unavailable(platform)` said None."""
    pyrender, renderer = _opened[platform]
    scene, near, far = _scene(pyrender, parts, camera, background)
    focal = 0.5 * height / camera.tangent
    picture = np.empty((height, width, 4), np.uint8)
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            tile = picture[top : top + TILE, left : left + TILE]
            rows, columns = SIDE * tile.shape[0], SIDE * tile.shape[1]
            renderer.viewport_width, renderer.viewport_height = columns, rows
            centre = SIDE * (0.5 * width - left), SIDE * (0.5 * height - top)
            eye = pyrender.IntrinsicsCamera(SIDE * focal, SIDE * focal, *centre, near / far, 1.01)
            node = scene.add(eye, pose=np.eye(4))
            flags = pyrender.RenderFlags
            drawn, _ = renderer.render(scene, flags=flags.FLAT | flags.SKIP_CULL_FACES | flags.RGBA)
            scene.remove_node(node)
            tile[:] = encode_rgba(
                _linear(drawn).reshape(rows // SIDE, SIDE, columns // SIDE, SIDE, 4).mean(axis=(1, 3))
            )
    return picture


def _scene(pyrender: Any, parts: list[Colored], camera: Camera, background: Colors) -> tuple[Any, float, float]:
    """The scene for pyrender, in the camera's axes and divided by the far distance; its near and far distances."""
    scene = pyrender.Scene(bg_color=[*map(float, srgb_curve(background[:3])), float(background[3])])
    axes = np.stack([camera.right, camera.up, -camera.forward], axis=1)
    parts = [part for part in parts if len(part.faces)]
    placed = [(part.points - camera.eye) @ axes for part in parts]
    near, far = _depths(placed)
    for part, points in zip(parts, placed):
        cover = np.ones((len(points), 1), np.float32) if part.cover is None else part.cover[:, None]
        ground = background[:3] if background[3] else part.colors
        color = srgb_curve(cover * part.colors + (1 - cover) * ground)
        color = np.concatenate([color, cover + (1 - cover) * background[3]], axis=1)
        primitive = pyrender.Primitive(
            positions=(points / far).astype(np.float32), indices=part.faces.astype(np.uint32), color_0=color, mode=4,
            material=pyrender.MetallicRoughnessMaterial(alphaMode="OPAQUE", baseColorFactor=[1.0, 1.0, 1.0, 1.0]),
        )  # fmt: skip
        scene.add(pyrender.Mesh([primitive]))
    return scene, near, far


def _linear(drawn: NDArray[np.uint8]) -> Colors:
    """Display-linear colours times coverage (..., 4) of sRGB bytes that the driver multiplied by coverage."""
    coverage = drawn[..., 3:].astype(np.float32) / 255
    if (drawn[..., 3] == 255).all():
        return np.concatenate([decode_srgb(drawn[..., :3]), coverage], axis=-1)
    whole = np.divide(drawn[..., :3], coverage, out=np.zeros(drawn[..., :3].shape, np.float32), where=coverage > 0)
    color = decode_srgb(np.clip(np.round(whole), 0, 255).astype(np.uint8))
    return np.concatenate([color * coverage, coverage], axis=-1)


def _depths(placed: list[Floats]) -> tuple[float, float]:
    """Distances of the near and the far plane that contain all points in front of the camera."""
    depth = np.concatenate([-p[:, 2] for p in placed]) if placed else np.ones(1)
    far = float(depth.max())
    if far <= 0:
        return 0.5, 1.0
    return max(float(depth.min()) * 0.99, far * 1e-3), far
