"""Other libraries in dedicated virtual environments: their pins conflict with ours and with one another's."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "docs" / "examples"
ROOTS = [ROOT / name for name in ("core", "proto", "manager", "worker", "factory", "trainer")]
OURS = (
    "numpy>=1.26",
    "msgspec>=0.19",
    "grpcio>=1.71",
    "protobuf>=5.29,<8",
    "pydantic>=2.9",
    "rich>=13.7",
    "typer>=0.15",
    "httpx>=0.27",
)
PHYSICS = ("pybullet==3.2.7", "scipy>=1.11")


class Peer:
    """Virtual environment of a library below $EMBOMATRIX_PEERS or the user's cache; created on first use."""

    def __init__(self, name, *packages):
        folder = os.environ.get("EMBOMATRIX_PEERS") or Path.home() / ".cache" / "embomatrix" / "peers"
        self.folder = Path(folder) / name
        self.python = self.folder / "bin" / "python"
        wanted = "\n".join((*OURS, *packages))
        ready = self.folder / "ready.txt"
        if not ready.is_file() or ready.read_text() != wanted:
            shutil.rmtree(self.folder, ignore_errors=True)
            subprocess.run([sys.executable, "-m", "venv", self.folder], check=True)
            pip = [self.python, "-m", "pip", "--quiet", "install", *OURS, *packages]
            subprocess.run(pip, check=True)
            ready.write_text(wanted)

    def run(self, *arguments, limit_s=600, **environment):
        """Run Python there with our sources and return its output. A failure raises with that output."""
        paths = os.pathsep.join(map(str, [*ROOTS, ROOT]))
        settings = {**os.environ, "PYTHONPATH": paths, "HF_HUB_OFFLINE": "1", **environment}
        done = subprocess.run(
            [self.python, *map(str, arguments)],
            capture_output=True,
            text=True,
            timeout=limit_s,
            env=settings,
            check=False,
        )
        assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-6000:]}"
        return done.stdout
