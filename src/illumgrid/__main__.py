"""Run the command line as ``python -m illumgrid``."""

from illumgrid.cli import main

main()
