"""Bundles: a scene, its tasks and its pose cache as one compressed, content-addressed file.

The digest covers the compressed bytes: a receiver checks it before it decompresses anything. Size and compression ratio are
bounded, so a hostile bundle costs only its transfer. The content is a JSON head that describes the structure, followed by
arrays with the numbers: see ``tables``.
"""

import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from embomatrix.world.bundle_head import FORMAT, HEAD, MAGIC
from embomatrix.world.codec import scene_of, scene_to_json
from embomatrix.world.codec_task import poses_of, poses_to_json, task_of, task_to_json
from embomatrix.world.inflation import (
    DEFAULT_LIMITS,
    BundleError,
    BundleLimits,
    bundle_digest,
    check_values,
    decompress,
    too_large,
)
from embomatrix.world.poses import PoseCache
from embomatrix.world.records import PosesJson, Record, SceneInvalidError, SceneJson, TaskJson, decode
from embomatrix.world.scene import Scene
from embomatrix.world.tables import Tables, TableWriter
from embomatrix.world.task import MAX_TASKS, Task

Arrays = Mapping[str, NDArray[np.generic]]

_ALIGNMENT: Final = 8
_DTYPES: Final[Mapping[str, np.dtype[Any]]] = {name: np.dtype(name) for name in ("<f8", "<i4", "|u1")}
_PREPARED: Final = "prepared."
MAX_ARRAYS: Final = 1_000
"""Arrays of a bundle; a scene needs about twenty."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """Scene, tasks by id and pose cache: all that a worker needs to execute plans.

    ``prepared`` holds arrays by name that the simulator derived from the scene beforehand. The simulator ignores unknown names
    and derives missing arrays again.
    """

    scene: Scene
    tasks: Mapping[str, Task]
    poses: PoseCache = field(default_factory=PoseCache)
    prepared: Arrays = field(default_factory=dict, compare=False)


class BundleJson(Record):
    """Head of a bundle. ``arrays`` lists the dtype and the shape of each array."""

    scene: SceneJson
    tasks: Annotated[list[TaskJson], Meta(max_length=MAX_TASKS)]
    poses: PosesJson
    arrays: Annotated[
        dict[str, Annotated[list[str | int], Meta(min_length=2, max_length=5)]], Meta(max_length=MAX_ARRAYS)
    ]


def encode_bundle(bundle: Bundle) -> bytes:
    """Encode a bundle; equal bundles give equal bytes. Raises BundleError for a task of another scene."""
    _check_tasks(bundle)
    tables = TableWriter()
    value: dict[str, Any] = {
        "scene": scene_to_json(bundle.scene, tables),
        "tasks": [task_to_json(bundle.tasks[task_id]) for task_id in sorted(bundle.tasks)],
        "poses": poses_to_json(bundle.poses, tables),
    }
    prepared = {f"{_PREPARED}{name}": array for name, array in sorted(bundle.prepared.items())}
    arrays = {name: _plain(name, array) for name, array in (tables.arrays() | prepared).items()}
    value["arrays"] = {name: [array.dtype.str, *array.shape] for name, array in arrays.items()}
    text = json.dumps(value, separators=(",", ":"), allow_nan=False, ensure_ascii=True).encode("ascii")
    text += b" " * (-(HEAD.size + len(text)) % _ALIGNMENT)
    parts = [HEAD.pack(MAGIC, FORMAT, len(text)), text]
    for array in arrays.values():
        data = array.tobytes()
        parts += [data, bytes(-len(data) % _ALIGNMENT)]
    return zlib.compress(b"".join(parts), level=6)


def read_bundle(path: Path, *, digest: str = "") -> Bundle:
    """Read a bundle file whose size is checked first. Raises BundleError or OSError."""
    with path.open("rb") as file:
        data = file.read(DEFAULT_LIMITS.compressed_bytes + 1)
    return decode_bundle(data, digest=digest)


def decode_bundle(data: bytes, *, digest: str = "", limits: BundleLimits = DEFAULT_LIMITS) -> Bundle:
    """Decode and check a bundle. ``digest`` is compared first unless it is empty. Raises BundleError."""
    if len(data) > limits.compressed_bytes:
        raise too_large(limits)
    found = bundle_digest(data)
    if digest and found != digest:
        raise BundleError(f"the bundle's digest is {found}: expected {digest}; fetch it again")
    try:
        bundle = _from_content(decompress(data, limits), limits)
    except (SceneInvalidError, BundleError) as error:
        raise BundleError(f"bundle {found}: {error}") from error
    except (ValueError, RecursionError) as error:
        raise BundleError(f"bundle {found} can't be read: {error}") from error
    _check_tasks(bundle)
    return bundle


def _from_content(content: bytes, limits: BundleLimits) -> Bundle:
    """Decode decompressed content. Raises ValueError for other data and SceneInvalidError for a broken rule."""
    if len(content) < HEAD.size or content[:4] != MAGIC:
        raise ValueError(
            f"it begins with {content[:4]!r}: expected {MAGIC!r}; build the dataset again with this version"
        )
    _, version, text_bytes = HEAD.unpack_from(content)
    if version != FORMAT:
        raise ValueError(
            f"it has format {version}: expected {FORMAT}; build the dataset again with this version"
        )
    end = HEAD.size + text_bytes
    if end > len(content) or end % _ALIGNMENT:
        raise ValueError(
            f"its JSON should have {text_bytes} bytes, but the bundle has {len(content)}: fetch it again"
        )
    check_values(memoryview(content)[HEAD.size : end], limits)
    record = decode(content[HEAD.size : end], BundleJson, "bundle")
    arrays = _arrays(record.arrays, memoryview(content)[end:])
    prepared = {
        name.removeprefix(_PREPARED): arrays.pop(name) for name in list(arrays) if name.startswith(_PREPARED)
    }
    tables = Tables(arrays)
    tasks = [task_of(task, f"bundle.tasks[{index}]") for index, task in enumerate(record.tasks)]
    return Bundle(
        scene=scene_of(record.scene, tables),
        tasks={task.task_id: task for task in tasks},
        poses=poses_of(record.poses, tables),
        prepared=prepared,
    )


def _arrays(described: Mapping[str, list[str | int]], data: memoryview) -> dict[str, NDArray[np.generic]]:
    """Read-only arrays by name; their bytes follow one another in ``data``."""
    arrays: dict[str, NDArray[np.generic]] = {}
    first = 0
    for name, (kind, *extents) in described.items():
        path = f"bundle.arrays[{name!r}]"
        dtype = _DTYPES.get(str(kind))
        if dtype is None:
            raise SceneInvalidError(path, f"found {str(kind)[:20]!r}: expected one of {', '.join(_DTYPES)}")
        shape = [extent for extent in extents if isinstance(extent, int) and extent >= 0]
        if len(shape) < len(extents):
            raise SceneInvalidError(path, f"found the shape {extents}: expected numbers from 0")
        count = math.prod(shape)
        size = count * dtype.itemsize
        if size > len(data) - first:
            raise SceneInvalidError(path, f"asks for {size} bytes: there are {len(data) - first} more")
        arrays[name] = np.frombuffer(data, dtype, count, first).reshape(shape)
        first += size + -size % _ALIGNMENT
    if first != len(data):
        raise SceneInvalidError("bundle.arrays", f"describes {first} bytes: there are {len(data)}")
    return arrays


def _plain(name: str, array: NDArray[np.generic]) -> NDArray[np.generic]:
    """Convert an array to the portable layout. Raises BundleError for an unsupported dtype."""
    kinds = {"f": "<f8", "i": "<i4", "u": "|u1", "b": "|u1"}
    kind = kinds.get(array.dtype.kind, "")
    if not kind or array.dtype.itemsize > _DTYPES[kind].itemsize or not array.ndim:
        raise BundleError(f"array {name!r} holds {array.dtype}: expected float64, int32, uint8 or bool")
    return np.ascontiguousarray(array, dtype=_DTYPES[kind])


def _check_tasks(bundle: Bundle) -> None:
    for task in bundle.tasks.values():
        if task.scene_id != bundle.scene.scene_id:
            raise BundleError(
                f"task {task.task_id!r} belongs to scene {task.scene_id!r}, the bundle holds {bundle.scene.scene_id!r}"
            )
        unknown = set(task.table) - set(bundle.scene.by_name)
        if unknown:
            raise BundleError(
                f"the table of task {task.task_id!r} names {min(unknown)!r}: the scene has no such object"
            )
