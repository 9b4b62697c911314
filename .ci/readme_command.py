"""Print the one command line that stands fenced under a section of the README: ``readme_command.py Run``."""

import pathlib
import re
import sys


def command(text: str, section: str) -> str:
    """Return the single line of the single fenced block under ``## section``; exit with a sentence on anything else."""
    parts = re.split(r"^## +(.+?) *$", text, flags=re.MULTILINE)
    bodies = [body for title, body in zip(parts[1::2], parts[2::2]) if title == section]
    if len(bodies) != 1:
        sys.exit(f"README.md has {len(bodies)} sections '## {section}'; expected exactly one")
    blocks = re.findall(r"^```[^\n]*\n(.*?)^```", bodies[0], flags=re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines() if line.strip()]
    if len(blocks) != 1 or len(lines) != 1:
        sys.exit(f"'## {section}' of README.md has {len(blocks)} fenced blocks, {len(lines)} lines; expected one, one")
    return lines[0]


if len(sys.argv) != 2:
    sys.exit("usage: readme_command.py SECTION")
print(command((pathlib.Path(__file__).parent.parent / "README.md").read_text(encoding="utf-8"), sys.argv[1]))
