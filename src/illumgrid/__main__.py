"""Run the command line, as ``illumgrid`` and as ``python -m illumgrid``."""

import signal
import sys


def main() -> None:
    """Import the command line and run it; Ctrl-C, SIGTERM and SIGHUP end an import without a traceback as well."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP, and nohup ignores it
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)
    try:
        from illumgrid.cli import main as command
    except KeyboardInterrupt:
        sys.stderr.write("illumgrid: stopped; nothing was written\n")
        raise SystemExit(130) from None
    command()


if __name__ == "__main__":
    main()
