"""Convex pieces of meshes: by CoACD (Wei et al., SIGGRAPH 2022), kept by the content of the mesh, or one per component."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol

import numpy as np
import trimesh

from embomatrix.factory.importers.model import ModelFileError
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from collections.abc import Sequence

    from embomatrix.factory.importers.model import Mesh
    from embomatrix.world.geometry import FloatArray

MAX_HULLS: Final = 16
"""Hulls of a link: Bullet drops further parts of one without a word."""
MAX_VERTICES: Final = 64
"""Corners of a hull. An asset may have 512; 64 keep a contact test quick and lose less than the margin of the engine."""


class Decomposer(Protocol):
    """Cuts a mesh into convex pieces: points (n, 3) of each, at most ``most`` of them."""

    def __call__(self, mesh: Mesh, most: int) -> list[FloatArray]: ...


def by_components(mesh: Mesh, most: int) -> list[FloatArray]:
    """The hull of each connected component; where there are too many, the smallest join their neighbours.

    Exact for models that are assembled from convex pieces, and quick.
    """
    # Not processed: it would weld boards that only touch.
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    pieces = [np.asarray(part.vertices) for part in whole.split(only_watertight=False)]
    return merged(pieces or [mesh.vertices], most)


def merged(pieces: Sequence[FloatArray], most: int) -> list[FloatArray]:
    """At most ``most`` pieces: the smallest joins the one whose middle is nearest, again and again."""
    left = sorted(pieces, key=_extent)
    while len(left) > most:
        smallest = left.pop(0)
        middle = _middle(smallest)
        nearest = min(range(len(left)), key=lambda k: float(np.linalg.norm(_middle(left[k]) - middle)))
        left[nearest] = np.vstack((left[nearest], smallest))
        left.sort(key=_extent)
    return left


@dataclass(frozen=True, slots=True)
class CoacdSettings:
    """What CoACD is asked: its own names. A higher threshold (of concavity) gives fewer pieces."""

    threshold: float = 0.08
    resolution: int = 1000
    mcts_iterations: int = 60
    max_ch_vertex: int = MAX_VERTICES
    seed: int = 0


class Coacd:
    """CoACD with a cache on disk: a mesh that was once cut is not cut again (0.1 to 30 s each)."""

    def __init__(self, folder: Path | None = None, settings: CoacdSettings | None = None) -> None:
        self._folder = folder or default_cache()
        self._settings = settings or CoacdSettings()

    def __call__(self, mesh: Mesh, most: int) -> list[FloatArray]:
        """Pieces of the mesh, from the cache where it has them. Raises ModelFileError where coacd is not installed."""
        path = self._folder / f"{self.key(mesh, most)}.json"
        kept = _kept(path)
        if kept is not None:
            return kept
        pieces = self._cut(mesh, most)
        self._folder.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps([piece.tolist() for piece in pieces]).encode())
        return pieces

    def key(self, mesh: Mesh, most: int) -> str:
        """Digest of all that the pieces depend on."""
        digest = hashlib.sha256()
        for array in (mesh.vertices.astype("<f8"), mesh.faces.astype("<i8")):
            digest.update(str(array.shape).encode() + array.tobytes())
        digest.update(json.dumps([asdict(self._settings), most, _version()]).encode())
        return digest.hexdigest()

    def _cut(self, mesh: Mesh, most: int) -> list[FloatArray]:
        try:
            import coacd
        except ImportError:
            raise ModelFileError(
                "coacd is not installed: `pip install embomatrix[importers]`, or cut by components (--cut components)"
            ) from None
        coacd.set_log_level("error")
        # Cut in the unit cube: its thresholds are shares of the size, and a model's units are its own.
        low = mesh.vertices.min(axis=0)
        scale = float((mesh.vertices.max(axis=0) - low).max()) or 1.0
        pieces = coacd.run_coacd(
            coacd.Mesh((mesh.vertices - low) / scale, mesh.faces.astype(np.int32)),
            max_convex_hull=most,
            decimate=True,
            **asdict(self._settings),
        )
        return merged([np.asarray(points, dtype=np.float64) * scale + low for points, _ in pieces], most)


def default_cache() -> Path:
    """Folder of the user's cache for cut meshes."""
    root = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(root) / "embomatrix" / "convex"


def _kept(path: Path) -> list[FloatArray] | None:
    """Pieces of a file of the cache; None when it is missing or damaged: then they are made again."""
    try:
        pieces = [np.asarray(piece, dtype=np.float64) for piece in json.loads(path.read_bytes())]
    except (OSError, ValueError):
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
