"""Run the command line, as ``illumgrid`` and as ``python -m illumgrid``."""

import signal
import sys


def main() -> None:
    """Import the command line and run it; Ctrl-C, SIGTERM and SIGHUP end it without a traceback wherever it is."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)  # Windows has no SIGHUP, and nohup ignores it
        if number is not None and signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)
    try:
        from illumgrid.cli import main as command

        command()
    except KeyboardInterrupt:  # before the command has begun, or after its end
        sentence = getattr(sys.modules.get("illumgrid.cli.stops"), "sentence", None)
        sys.stderr.write(f"{sentence() if sentence else 'illumgrid: stopped; nothing was written'}\n")
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
