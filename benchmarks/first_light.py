"""Processor seconds of `illumgrid view VOLUME` from the start of the process until its page with coarse light is there.

Usage: python benchmarks/first_light.py VOLUME [ROUNDS]. The first round may compile kernels. Each begins in an empty
folder, reads the whole page as a browser does, and ends the process at once; what it used is that of all its threads.
"""

import os
import re
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path


def first_light(volume: Path) -> tuple[float, float]:
    """Seconds of processors and of the clock."""
    with tempfile.TemporaryDirectory() as folder:
        begun, command = time.perf_counter(), [sys.executable, "-m", "illumgrid", "view", str(volume), "--no-open"]
        process = subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True)
        try:
            assert process.stderr is not None
            address = next(filter(None, (re.search(r"http://\S+", line) for line in process.stderr)))[0]
            with urllib.request.urlopen(address) as answer:
                page = answer.read()
            took = time.perf_counter() - begun
        finally:
            process.kill()
            used = os.wait4(process.pid, 0)[2]
        assert b'"live":' in page  # and not that of a finished run
        return used.ru_utime + used.ru_stime, took


if __name__ == "__main__":
    for _ in range(int(sys.argv[2]) if len(sys.argv) > 2 else 3):
        print("{:.2f} s of processors, {:.2f} s of the clock".format(*first_light(Path(sys.argv[1]).resolve())))
