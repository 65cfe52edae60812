"""Version of the code that runs: a commit, or the version of the installed package."""

import importlib.metadata
import subprocess
from pathlib import Path
from typing import Final

GIT_S: Final = 10.0


def commit_here() -> str:
    """Commit of the checkout that this code runs from, ``-dirty`` if changed; else the package's version."""
    here = Path(__file__).resolve()
    try:
        # An install inside another repository's folder must not name that repository's commit.
        _git(here.parent, "ls-files", "--error-unmatch", here.name)
        return _git(here.parent, "describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")
    except (OSError, subprocess.SubprocessError):
        return f"version {importlib.metadata.version('embomatrix')}"


def _git(folder: Path, *arguments: str) -> str:
    command = ("git", "-C", str(folder), *arguments)
    answer = subprocess.run(command, capture_output=True, text=True, timeout=GIT_S, check=True)
    return answer.stdout.strip()
