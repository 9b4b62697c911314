"""Time of the whole chain, as a user sees it: ``python benchmarks/chain.py [VOLUME --range LO HI]``.

Wall time and peak memory of whole processes: ``--help``, the first run of the built-in scene (which compiles the
kernels into an empty cache), the second run, and, if VOLUME is given, a default run of it.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time


def timed(what, arguments, environment):
    """Print seconds and peak memory of one run of the command line."""
    start = time.perf_counter()
    subprocess.run([sys.executable, "-m", "illumgrid", *arguments], env=environment, check=True, capture_output=True)
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"  {what:40} {seconds:7.2f} s   largest process so far {peak:6.0f} MB")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("volume", nargs="?")
    parser.add_argument("--range", nargs=2, default=[])
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": os.path.join(folder, "cache")}
        output = ["--overwrite", "-o", os.path.join(folder, "light")]
        timed("--help", ["--help"], environment)
        timed("built-in scene, first run: compiles", ["run", *output], environment)
        timed("built-in scene, second run", ["run", *output], environment)
        if asked.volume:
            limits = ["--range", *asked.range] if asked.range else []
            timed(os.path.basename(asked.volume), ["run", asked.volume, *limits, *output], environment)


if __name__ == "__main__":
    main()
