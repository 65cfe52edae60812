"""Triangle meshes of OBJ, STL and GLB files by group, without materials and textures."""

import io
import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import trimesh

from embomatrix.factory.importers.model import IntArray, Mesh, ModelFileError, read_bytes
from embomatrix.world.geometry import FloatArray

GROUPED: Final = frozenset({".obj", ".glb", ".stl"})


def read_groups(path: Path) -> Mapping[str, Mesh]:
    """Return the meshes of a file by the name of their group or node, all in the file's frame.

    Raises ModelFileError for another type of file, or one that is damaged.
    """
    data = read_bytes(path)
    match path.suffix.lower():
        case ".obj":
            meshes = _obj(data, path)
        case ".glb" | ".stl" as suffix:
            meshes = _binary(data, suffix[1:], path)
        case suffix:
            raise ModelFileError(f"{path} ends in {suffix!r}: expected one of {', '.join(sorted(GROUPED))}")
    if not meshes:
        raise ModelFileError(f"{path} contains no face: expected a triangle mesh")
    return meshes


def _obj(data: bytes, path: Path) -> Mapping[str, Mesh]:
    """Read Wavefront OBJ. Libraries drop the group names, which mark moving parts, and the line numbers of errors."""
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
            raise ModelFileError(
                f"{path}, line {number}: found {line[:60]!r}: expected a vertex such as `v 0 0 1` or a face such as `f 1 2 3`"
            ) from None
    points = np.array(vertices, dtype=np.float64).reshape(-1, 3)
    return {
        name: _cut(points, np.array(faces, dtype=np.int64), path) for name, faces in groups.items() if faces
    }


def _corner(word: str, count: int) -> int:
    """Return the index of a vertex; OBJ counts from 1, or from the end if negative."""
    index = int(word.split("/", 1)[0])
    found = index - 1 if index > 0 else count + index
    if not 0 <= found < count:
        raise ValueError(word)
    return found


def _binary(data: bytes, kind: str, path: Path) -> Mapping[str, Mesh]:
    """Read GLB or STL with trimesh from memory: files that it references are never opened."""
    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type=kind)
        found = {
            name: scene.geometry[scene.graph[name][1]].copy().apply_transform(scene.graph[name][0])
            for name in scene.graph.nodes_geometry
        }
    except Exception as error:  # noqa: BLE001 - a damaged file fails anywhere in the reader, with any exception
        raise ModelFileError(f"{path} can't be read as {kind}: {error}") from None
    return {
        name: _cut(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64), path)
        for name, mesh in found.items()
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)
    }


def _cut(points: FloatArray, faces: IntArray, path: Path) -> Mesh:
    """Return the mesh of some faces with only the vertices that they use."""
    try:
        whole = Mesh(points, faces)
        used, index = np.unique(whole.faces, return_inverse=True)
        return Mesh(points[used], index.reshape(faces.shape))
    except ModelFileError as error:
        raise ModelFileError(f"{path}: {error}") from None
