"""Operations of the path loop on the surface that represents a level set; the type of the scene selects them.

There are two: `march` for a scene of type `illumgrid.field.levelset.Marchable`, and `mesh.cast` for
`mesh.meshes.Meshed`. Only the operations for the type in use are compiled.
"""

from functools import singledispatch
from typing import Any

from numba.extending import overload

from illumgrid.compiled import PartCompiler

_OPTIONS = {
    "nogil": True, "error_model": "numpy", "_nrt": False, "no_cfunc_wrapper": True, "pipeline_class": PartCompiler
}  # fmt: skip


def question(stub: Any) -> Any:
    """Make a stub a generic function of the scene's type, both compiled and as plain Python."""
    generic = singledispatch(stub)

    @overload(generic, jit_options=_OPTIONS)  # type: ignore[arg-type]
    def _(scene, *rest):
        answer = generic.dispatch(scene.instance_class)
        return lambda scene, *rest: answer(scene, *rest)

    return generic


@question
def meet_solid(scene, f, level, x, n, d, own, face, limit):
    """First meeting of the frame ray x + t d with the solid of field f, t < limit: (t, what, face).

    The ray starts on a surface of normal n; `own`: on that solid, at `face`.
    """


@question
def solid_normal(scene, f, what, face, x, d):
    """Normal where a ray along d met the solid of field f at x."""


@question
def inside(scene, f, level, x, n):
    """Whether the frame point x, on another surface of normal n, lies in the solid of field f, its border included."""


@question
def begin(scene, own, x, n):
    """Move a query from the trilinear level set onto the surface that represents it: (position, face); LOST if none."""
