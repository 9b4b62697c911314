"""Run the command line, as ``illumgrid`` and as ``python -m illumgrid``."""

import os
import signal
import sys
from contextlib import suppress
from types import FrameType


def main() -> None:
    """Import the command line and run it; Ctrl-C, SIGTERM and SIGHUP end it without a traceback wherever it is."""
    for stream, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, stream) is None:  # closed, as by >&-: the next file would take its number
            setattr(sys, stream, open(os.devnull, mode, encoding="utf-8"))  # noqa: SIM115
    came = []

    def stop(number: int, frame: FrameType | None) -> None:
        came.append(number)
        raise KeyboardInterrupt

    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP, and nohup ignores it
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, stop)
    try:
        from illumgrid.cli import main as command

        command()
    except (KeyboardInterrupt, Exception) as error:  # before the command has begun, or after its end
        if not came and not isinstance(error, KeyboardInterrupt):  # an import may turn a stop into another exception
            raise
        sentence = getattr(sys.modules.get("illumgrid.cli.stops"), "sentence", None)
        with suppress(OSError, ValueError):
            sys.stdout.flush()
            sys.stderr.write(f"{sentence() if sentence else 'illumgrid: stopped; nothing was written'}\n")
            sys.stderr.flush()
        os._exit(130)  # Python ends by SIGINT if the stop came within exec, as while a dataclass is made


if __name__ == "__main__":
    main()
