"""The process that `isolated` starts: it opens HDF5 or Zarr and answers requests on its input."""

import io
import json
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

_MOST = 10_000
"""Largest number of datasets that are examined."""

ROOM = 1 << 29
"""Bytes of memory for headers, beyond what the process has at its start."""


def _taken() -> int:
    """Bytes of address space that this process has."""
    return int(Path("/proc/self/statm").read_text("ascii").split()[0]) * os.sysconf("SC_PAGE_SIZE")


def _confine(base: int, asked: dict[str, Any]) -> None:
    """End this process if a request takes more memory or time than its size explains."""
    with suppress(ImportError, AttributeError, OSError, ValueError):  # not available on Windows
        import resource

        signal.setitimer(signal.ITIMER_PROF, 10 + asked["bytes"] / 1e7)
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        soft = base + ROOM + 4 * asked["bytes"]
        resource.setrlimit(resource.RLIMIT_AS, (soft if hard < 0 else min(soft, hard), hard))


def _hdf5(file: Any) -> Callable[[dict[str, Any]], Any]:
    import h5py

    node = h5py.File(file, "r")

    def answer(asked: dict[str, Any]) -> Any:
        if "index" in asked:
            return node[asked["name"]][_index(asked)]
        if "name" in asked:
            return _described(node[asked["name"]])
        return {"itk": "ITKImage" in node, "names": _datasets(node)}

    return answer


def _datasets(file: Any) -> list[str]:
    """Names of datasets of three or more axes; links to other files are not followed."""
    import h5py

    found: list[str] = []

    def look(name: str, node: Any) -> bool | None:
        if isinstance(node, h5py.Dataset) and len(node.shape or ()) >= 3 and node.dtype.kind in "biuf":
            found.append(name)
        return True if len(found) >= _MOST else None

    file.visititems(look)
    return sorted(found)


def _described(data: Any) -> dict[str, Any]:
    sizes = np.ravel(data.attrs.get("element_size_um", ()))  # of ilastik and Fiji, in the order of the axes
    return {
        "shape": data.shape,
        "dtype": data.dtype.str,
        "chunks": data.chunks or (1,) * len(data.shape),
        "names": [dim.label.lower() for dim in data.dims],
        "sizes": sizes[:32].astype(float).tolist() if sizes.dtype.kind in "iuf" else [],
        "elsewhere": bool(data.is_virtual or data.external),
    }


def _zarr(folder: Any) -> Callable[[dict[str, Any]], Any]:
    import zarr

    def answer(asked: dict[str, Any]) -> Any:
        array: Any = zarr.open(folder, path=asked["name"], mode="r")
        return array[_index(asked)]

    return answer


def _index(asked: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(slice(*part) if isinstance(part, list) else part for part in asked["index"])


def _answers(kind: str, place: str) -> Iterator[tuple[dict[str, Any], bytes]]:
    """An answer to each request: a record, and the bytes of an array that it describes."""
    base, answer = 0, None
    with suppress(OSError):  # macOS has no /proc
        base = _taken()
    for line in sys.stdin.buffer:
        try:
            asked = json.loads(line)
            _confine(base, asked)
            if answer is None:
                packed = sys.stdin.buffer.read(asked["packed"])
                answer = {"hdf5": _hdf5, "zarr": _zarr}[kind](io.BytesIO(packed) if packed else place)
                yield {}, b""
                continue
            found = answer(asked)
            if isinstance(found, dict):
                yield found, b""
            else:
                array = np.asarray(found)
                yield {"dtype": array.dtype.str, "shape": array.shape}, array.tobytes()
        except MemoryError:
            yield {"memory": True}, b""
        except Exception as problem:
            yield {"error": f"{problem}" or type(problem).__name__}, b""


def main() -> None:
    """Answer until there are no more requests."""
    import warnings

    warnings.simplefilter("ignore")
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    with os.fdopen(os.dup(1), "wb") as out:
        os.dup2(2, 1)  # libraries may print
        for record, raw in _answers(*sys.argv[1:]):
            out.write(json.dumps({**record, "size": len(raw)}).encode() + b"\n" + raw)
            out.flush()


if __name__ == "__main__":
    main()
