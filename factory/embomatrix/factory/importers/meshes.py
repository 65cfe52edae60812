"""Triangle meshes from OBJ, STL and GLB files, group by group, with nothing else of the file: no materials, no textures."""

from __future__ import annotations

import io
import itertools
from typing import TYPE_CHECKING, Final

import numpy as np
import trimesh

from embomatrix.factory.importers.model import Mesh, ModelFileError, read_bytes

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from embomatrix.factory.importers.model import IntArray
    from embomatrix.world.geometry import FloatArray

GROUPED: Final = frozenset({".obj", ".glb", ".stl"})


def read_groups(path: Path) -> Mapping[str, Mesh]:
    """Meshes of a file by the name of their group or node, all in the file's frame.

    Raises ModelFileError for a file of another kind, or one that is damaged.
    """
    data = read_bytes(path)
    match path.suffix.lower():
        case ".obj":
            return _obj(data, path)
        case ".glb" | ".stl" as suffix:
            return _binary(data, suffix[1:], path)
        case suffix:
            raise ModelFileError(f"{path} ends in {suffix!r}: expected one of {', '.join(sorted(GROUPED))}")


def _obj(data: bytes, path: Path) -> Mapping[str, Mesh]:
    """Wavefront OBJ. Read here and not by a library: its names of groups say what moves, and a line can be named."""
    vertices: list[tuple[float, ...]] = []
    groups: dict[str, list[tuple[int, int, int]]] = {}
    group = "base"
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), start=1):
        kind, *words = line.split() or ("",)
        try:
            if kind == "v":
                x, y, z = map(float, words[:3])
                vertices.append((x, y, z))
            elif kind in ("g", "o"):
                group = "_".join(words) or "base"
            elif kind == "f":
                corners = [_corner(word, len(vertices)) for word in words]
                fan = [(corners[0], b, c) for b, c in itertools.pairwise(corners[1:])]
                groups.setdefault(group, []).extend(fan)
        except ValueError:
            raise ModelFileError(f"{path}, line {number}: {line[:60]!r} is no vertex and no face") from None
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    meshes = {
        name: _cut(points, np.array(faces, dtype=np.int64), path) for name, faces in groups.items() if faces
    }
    if not meshes:
        raise ModelFileError(f"{path} holds no face: expected a triangle mesh")
    return meshes


def _corner(word: str, count: int) -> int:
    """Index of a vertex; OBJ counts from 1, and from the end with a minus sign."""
    index = int(word.split("/", 1)[0])
    found = index - 1 if index > 0 else count + index
    if not 0 <= found < count:
        raise ValueError(word)
    return found


def _binary(data: bytes, kind: str, path: Path) -> Mapping[str, Mesh]:
    """GLB and STL by trimesh, from memory: nothing that the file names is opened."""
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind)
        found = {
            name: scene.geometry[scene.graph[name][1]].copy().apply_transform(scene.graph[name][0])
            for name in scene.graph.nodes_geometry
        }
    except Exception as error:  # noqa: BLE001 - a damaged file fails anywhere in the reader, with any exception
        raise ModelFileError(f"{path} is no {kind} that can be read: {error}") from None
    meshes = {
        name: _cut(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64), path)
        for name, mesh in found.items()
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)
    }
    if not meshes:
        raise ModelFileError(f"{path} holds no face: expected a triangle mesh")
    return meshes


def _cut(points: FloatArray, faces: IntArray, path: Path) -> Mesh:
    """The mesh of some faces with the vertices that they use."""
    try:
        used, index = np.unique(faces, return_inverse=True)
        return Mesh(points[used], index.reshape(faces.shape))
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from None
