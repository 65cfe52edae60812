"""Content of a model file: links of triangle meshes and their motions, in the file's own frame and units."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from embomatrix.world.asset import JointKind
from embomatrix.world.geometry import FloatArray

IntArray = NDArray[np.int64]

MAX_BYTES: Final = 64 * 1024 * 1024
MAX_FACES: Final = 400_000


class ModelFileError(Exception):
    """Model file that can't be imported. The message names the file, what was found and what was expected."""


class AxisConvention(StrEnum):
    """Directions of a file's axes."""

    Y_UP = "y"  # x width, y up, z towards the viewer of its front: OBJ of Sweet Home 3D, glTF
    Z_UP = "z"  # x forward, y to the left, z up: URDF


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangle mesh: vertices (n, 3), faces (m, 3). ``convex`` means that the mesh equals its convex hull."""

    vertices: FloatArray
    faces: IntArray
    convex: bool = False

    def __post_init__(self) -> None:
        if len(self.vertices) < 3 or len(self.faces) < 1:
            raise ModelFileError(
                f"a mesh has {len(self.vertices)} vertices and {len(self.faces)} faces: it is empty"
            )
        if not np.isfinite(self.vertices).all():
            raise ModelFileError("a vertex is not a finite number")
        if self.faces.min() < 0 or self.faces.max() >= len(self.vertices):
            raise ModelFileError(f"a face names a vertex outside 0 .. {len(self.vertices) - 1}")
        if len(self.faces) > MAX_FACES:
            raise ModelFileError(
                f"a mesh has {len(self.faces)} faces: expected at most {MAX_FACES}; simplify it first"
            )


@dataclass(frozen=True, slots=True)
class Motion:
    """Joint of a link in the file's frame; ``upper`` is the travel in radians or in the file's units of length."""

    kind: JointKind
    origin: tuple[float, float, float]
    axis: tuple[float, float, float]
    upper: float


@dataclass(frozen=True, slots=True)
class RawLink:
    """Meshes that move together. The first link of a model is its base, without a motion."""

    name: str
    meshes: tuple[Mesh, ...]
    motion: Motion | None = None


@dataclass(frozen=True, slots=True)
class RawModel:
    """Links of a model file and the convention of its axes."""

    links: tuple[RawLink, ...]
    frame: AxisConvention


def triple(values: FloatArray) -> tuple[float, float, float]:
    """Return an array of shape (3,) as a tuple."""
    x, y, z = (float(value) for value in values)
    return (x, y, z)


def read_bytes(path: Path) -> bytes:
    """Return the file's content. Raises ModelFileError if it is missing, unreadable, empty or larger than 64 MiB."""
    try:
        size = path.stat().st_size
        if not 0 < size <= MAX_BYTES:
            raise ModelFileError(f"{path} has {size} bytes: expected 1 to {MAX_BYTES}")
        return path.read_bytes()
    except OSError as error:
        raise ModelFileError(f"{path} can't be read: {error.strerror}") from None
