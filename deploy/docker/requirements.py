"""Print the requirements of extras of this project, one per line, so that an image layer holds dependencies only.

A source change then rebuilds no dependency.  Usage: requirements.py PYPROJECT EXTRA [EXTRA ...]
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

_OWN = "embomatrix["


def requirements(project: dict[str, object], extras: list[str]) -> list[str]:
    """Return the requirements of the project and the extras. Extras of this project inside extras are resolved."""
    optional: dict[str, list[str]] = project["optional-dependencies"]  # type: ignore[assignment]
    found = list(project["dependencies"])  # type: ignore[call-overload]
    waiting = list(extras)
    while waiting:
        for line in optional[waiting.pop()]:
            if line.startswith(_OWN):
                waiting += line.removeprefix(_OWN).removesuffix("]").split(",")
            elif line not in found:
                found.append(line)
    return found


if __name__ == "__main__":
    manifest = tomllib.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    sys.stdout.write("\n".join(requirements(manifest["project"], sys.argv[2:])) + "\n")
