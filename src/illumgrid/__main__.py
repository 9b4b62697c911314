"""Run the command line, as ``illumgrid`` and as ``python -m illumgrid``."""

import sys


def main() -> None:
    """Import the command line and run it; Ctrl-C ends an import without a traceback as well."""
    try:
        from illumgrid.cli import main as command
    except KeyboardInterrupt:
        sys.stderr.write("illumgrid: stopped; nothing was written\n")
        raise SystemExit(130) from None
    command()


if __name__ == "__main__":
    main()
