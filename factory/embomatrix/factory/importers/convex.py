"""Convex decomposition of meshes: by CoACD (Wei et al., SIGGRAPH 2022) with a disk cache, or one hull per component."""

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Final

import numpy as np
import trimesh

from embomatrix.factory.importers.model import Mesh, ModelFileError
from embomatrix.world.geometry import FloatArray
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

MAX_HULLS: Final = 16
"""Upper limit for the hulls of a link: Bullet silently drops further ones."""
MAX_VERTICES: Final = 64
"""Upper limit for the corners of a hull. The engine takes 512; with 64, contact tests stay fast and the error is below its
margin."""


Decomposer = Callable[[Mesh, int], list[FloatArray]]
"""Function that cuts a mesh into at most so many convex pieces, each given by points (n, 3)."""
COACD_SETTINGS: Final = {
    "threshold": 0.08,
    "resolution": 1000,
    "mcts_iterations": 60,
    "max_ch_vertex": MAX_VERTICES,
    "seed": 0,
}
"""Parameters of CoACD under its own names. A higher threshold (of concavity) gives fewer pieces."""


def by_components(mesh: Mesh, most: int) -> list[FloatArray]:
    """Return the points of each connected component; if there are too many, the smallest join their neighbours.

    Fast, and exact for models assembled from convex pieces.
    """
    # Processing would weld boards that only touch.
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    pieces = [np.asarray(part.vertices) for part in whole.split(only_watertight=False)]
    return merged(pieces or [mesh.vertices], most)


def merged(pieces: Sequence[FloatArray], most: int) -> list[FloatArray]:
    """Join the smallest piece with the one whose centre is nearest until at most ``most`` pieces are left."""
    left = sorted(pieces, key=_extent)
    while len(left) > most:
        smallest = left.pop(0)
        middle = _middle(smallest)
        nearest = min(range(len(left)), key=lambda k: float(np.linalg.norm(_middle(left[k]) - middle)))
        left[nearest] = np.vstack((left[nearest], smallest))
        left.sort(key=_extent)
    return left


class Coacd:
    """CoACD with a cache on disk: cutting a mesh takes 0.1 to 30 s."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder or default_cache()

    def __call__(self, mesh: Mesh, most: int) -> list[FloatArray]:
        """Return the pieces of the mesh, cached if possible. Raises ModelFileError if coacd is not installed."""
        path = self._folder / f"{self.key(mesh, most)}.json"
        kept = _kept(path)
        if kept is not None:
            return kept
        pieces = self._cut(mesh, most)
        self._folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps([piece.tolist() for piece in pieces]).encode())
        return pieces

    def key(self, mesh: Mesh, most: int) -> str:
        """Return the digest of everything that the pieces depend on."""
        digest = hashlib.sha256()
        for array in (mesh.vertices.astype("<f8"), mesh.faces.astype("<i8")):
            digest.update(str(array.shape).encode() + array.tobytes())
        digest.update(json.dumps([COACD_SETTINGS, most, _version()]).encode())
        return digest.hexdigest()

    def _cut(self, mesh: Mesh, most: int) -> list[FloatArray]:
        try:
            import coacd
        except ImportError:
            raise ModelFileError(
                "coacd is not installed: `pip install '.[importers]'` in the checkout, or cut by components (--cut components)"
            ) from None
        coacd.set_log_level("error")
        # CoACD's thresholds are shares of the size, so the mesh is scaled to the unit cube.
        low = mesh.vertices.min(axis=0)
        scale = float((mesh.vertices.max(axis=0) - low).max()) or 1.0
        pieces = coacd.run_coacd(
            coacd.Mesh((mesh.vertices - low) / scale, mesh.faces.astype(np.int32)),
            max_convex_hull=most,
            decimate=True,
            **COACD_SETTINGS,
        )
        return merged([np.asarray(points, dtype=np.float64) * scale + low for points, _ in pieces], most)


def default_cache() -> Path:
    """Return the user's cache folder for cut meshes."""
    root = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(root) / "embomatrix" / "convex"


def _kept(path: Path) -> list[FloatArray] | None:
    """Return the pieces of a cache file; None if it is missing or damaged."""
    try:
        pieces = [np.asarray(piece, dtype=np.float64) for piece in parse_json(path.read_bytes())]
    except (OSError, ValueError, TypeError, OverflowError):
        return None
    sound = all(piece.ndim == 2 and piece.shape[1] == 3 and np.isfinite(piece).all() for piece in pieces)
    return pieces if pieces and sound else None


def _version() -> str:
    try:
        return metadata.version("coacd")
    except metadata.PackageNotFoundError:
        return ""


def _extent(points: FloatArray) -> float:
    return float(np.prod(points.max(axis=0) - points.min(axis=0)))


def _middle(points: FloatArray) -> FloatArray:
    return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)
