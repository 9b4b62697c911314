"""A backend for illumgrid: the paths of `numba` on an NVIDIA graphics card."""

from dataclasses import dataclass
from typing import ClassVar, Literal

from illumgrid.stages import hookimpl
from illumgrid.transport.tracer import laid_out, solve_once


@dataclass(frozen=True)
class Cuda:
    """The paths of `numba` on a graphics card, with the same random numbers, through the trilinear level sets.

    Parameters
    ----------
    device : {"card", "processor"}
        Where the kernels run; "processor" compiles them for one core, to test them where there is no card.
    """

    name: ClassVar[str] = "cuda"
    contract: ClassVar[int] = 2
    geometry: ClassVar[str] = "levelset"
    device: Literal["card", "processor"] = "card"

    def __post_init__(self):
        if self.device not in ("card", "processor"):
            raise ValueError(f"device is {self.device!r}; expected 'card' or 'processor'")

    @classmethod
    def available(cls):
        """None, or what would make it so."""
        try:
            from numba import cuda

            if cuda.is_available():
                return None
            reason = str(getattr(cuda.cuda_error(), "msg", None) or cuda.cuda_error() or "no card was found")
        except Exception as problem:
            reason = str(problem) or type(problem).__name__
        return f"install an NVIDIA card with its driver ({' '.join(reason.split()).partition('. ')[0][:100]})"

    def prepare(self, scene):
        """Lay the fields out and take them to the device, once."""
        from illumgrid_cuda.tracer import CudaTracer

        return CudaTracer(self, scene, *laid_out(scene))

    solve = solve_once


@hookimpl
def register_backends():
    """Name the backend to illumgrid."""
    return [Cuda]
