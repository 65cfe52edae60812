"""Bundles: a scene, its tasks and its pose cache as one compressed, content-addressed file.

The digest is taken of the compressed bytes, so a receiver checks it before it decompresses anything; the size and the
ratio of decompression are bounded, so a hostile bundle costs nothing but its transfer. Compressed is a head, JSON that says
how everything hangs together, and arrays that hold the numbers: see ``tables``.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
import zlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from embomatrix.world.codec import scene_from_json, scene_to_json
from embomatrix.world.codec_task import poses_from_json, poses_to_json, task_from_json, task_to_json
from embomatrix.world.field import Field, SceneInvalidError
from embomatrix.world.poses import PoseCache
from embomatrix.world.tables import Tables, TableWriter

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from embomatrix.world.scene import Scene
    from embomatrix.world.task import Task

    Arrays = Mapping[str, NDArray[np.generic]]

FORMAT: Final = 3
MAGIC: Final = b"EMBX"
_HEAD: Final = struct.Struct("<4sII")
"""Magic, format, bytes of JSON."""
_ALIGNMENT: Final = 8
_DTYPES: Final[Mapping[str, np.dtype[Any]]] = {name: np.dtype(name) for name in ("<f8", "<i4", "|u1")}
_PREPARED: Final = "prepared."
_CHUNK: Final = 1 << 20
"""What a bundle may grow by beyond its ratio: the smallest ones compress best."""
_PIECE: Final = 1 << 16


class BundleError(ValueError):
    """A bundle can't be accepted. The message tells what was found and what was expected."""


@dataclass(frozen=True, slots=True)
class BundleLimits:
    """What a bundle may cost before it is known to be sound."""

    compressed_bytes: int = 8 * 1024 * 1024
    ratio: float = 100.0
    """Decompressed bytes for each compressed byte; scenes need about ten."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """What a worker needs to execute plans in a scene. ``tasks`` maps a task's id to the task.

    ``prepared`` are arrays that the simulator derived from the scene beforehand, by name. They are its own affair: what it
    does not know it leaves alone, and what is missing it derives again.
    """

    scene: Scene
    tasks: Mapping[str, Task]
    poses: PoseCache = field(default_factory=PoseCache)
    prepared: Arrays = field(default_factory=dict, compare=False)


DEFAULT_LIMITS: Final = BundleLimits()


def encode_bundle(bundle: Bundle) -> bytes:
    """Compressed bytes: equal bundles give equal bytes. Raises BundleError for a task of another scene."""
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
    text += b" " * (-(_HEAD.size + len(text)) % _ALIGNMENT)
    parts = [_HEAD.pack(MAGIC, FORMAT, len(text)), text]
    for array in arrays.values():
        data = array.tobytes()
        parts += [data, bytes(-len(data) % _ALIGNMENT)]
    return zlib.compress(b"".join(parts), level=6)


def bundle_digest(data: bytes) -> str:
    """Content address of a bundle: ``sha256:`` and the hash of its compressed bytes in hexadecimal digits."""
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def read_bundle(path: Path, *, digest: str = "", limits: BundleLimits = DEFAULT_LIMITS) -> Bundle:
    """The bundle in a file, whose size is looked at before it is read. Raises BundleError, or OSError."""
    with path.open("rb") as file:
        data = file.read(limits.compressed_bytes + 1)
    return decode_bundle(data, digest=digest, limits=limits)


def decode_bundle(data: bytes, *, digest: str = "", limits: BundleLimits = DEFAULT_LIMITS) -> Bundle:
    """The bundle, checked in every part. ``digest`` is compared first unless it is empty. Raises BundleError."""
    if len(data) > limits.compressed_bytes:
        raise _too_large(limits)
    found = bundle_digest(data)
    if digest and found != digest:
        raise BundleError(f"the bundle's digest is {found}, expected {digest}")
    try:
        bundle = _from_content(_decompress(data, limits))
    except SceneInvalidError as error:
        raise BundleError(f"bundle {found}: {error}") from error
    except (ValueError, RecursionError) as error:
        raise BundleError(f"bundle {found} can't be read: {error}") from error
    _check_tasks(bundle)
    return bundle


def _from_content(content: bytes) -> Bundle:
    """Raises ValueError for what is no bundle, SceneInvalidError for one that breaks a rule."""
    if len(content) < _HEAD.size or content[:4] != MAGIC:
        raise ValueError(
            f"it begins with {content[:4]!r}, expected {MAGIC!r}: build the dataset anew with this version"
        )
    _, version, text_bytes = _HEAD.unpack_from(content)
    if version != FORMAT:
        raise ValueError(
            f"it has format {version}, this version reads {FORMAT}: build the dataset anew with it"
        )
    end = _HEAD.size + text_bytes
    if end > len(content) or end % _ALIGNMENT:
        raise ValueError(f"its JSON has {text_bytes} bytes, {len(content)} are there in all")
    value = json.loads(content[_HEAD.size : end], parse_constant=_refuse_constant)
    fields = Field(value, "bundle").record("scene", "tasks", "poses", "arrays")
    arrays = _arrays(fields["arrays"], memoryview(content)[end:])
    prepared = {
        name.removeprefix(_PREPARED): arrays.pop(name) for name in list(arrays) if name.startswith(_PREPARED)
    }
    tables = Tables(arrays)
    tasks = [task_from_json(item.value) for item in fields["tasks"].items()]
    return Bundle(
        scene=scene_from_json(fields["scene"].value, tables),
        tasks={task.task_id: task for task in tasks},
        poses=poses_from_json(fields["poses"].value, tables),
        prepared=prepared,
    )


def _arrays(field: Field, data: memoryview) -> dict[str, NDArray[np.generic]]:
    """Read-only arrays by name, as the field describes them, one after another."""
    arrays: dict[str, NDArray[np.generic]] = {}
    first = 0
    for name, described in field.entries():
        kind, *extents = described.items(at_most=5)
        dtype = _DTYPES.get(kind.text())
        if dtype is None:
            kind.fail(f"found {kind.text()[:20]!r}: expected one of {', '.join(_DTYPES)}")
        shape = tuple(item.integer() for item in extents)
        if not shape or min(shape) < 0:
            described.fail(f"found the shape {shape}: expected numbers from 0")
        count = math.prod(shape)
        size = count * dtype.itemsize
        if size > len(data) - first:
            described.fail(f"asks for {size} bytes: there are {len(data) - first} more")
        arrays[name] = np.frombuffer(data, dtype, count, first).reshape(shape)
        first += size + -size % _ALIGNMENT
    if first != len(data):
        field.fail(f"describes {first} bytes: there are {len(data)}")
    return arrays


def _plain(name: str, array: NDArray[np.generic]) -> NDArray[np.generic]:
    """The array in a layout that every machine reads. Raises BundleError for one of another type."""
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


class Inflation:
    """Decompresses a bundle while it comes, and refuses it at the first piece that breaks a limit.

    Whoever takes bundles in uses this: what one side accepts, every other accepts.
    """

    def __init__(self, limits: BundleLimits = DEFAULT_LIMITS) -> None:
        self._limits = limits
        self._decoder = zlib.decompressobj()
        self._taken = 0
        self._grown = 0

    def feed(self, data: bytes) -> Iterator[bytes]:
        """What the next bytes of the bundle hold, in pieces that fit in memory. Raises BundleError."""
        for start in range(0, len(data), _PIECE):
            yield self._inflate(data[start : start + _PIECE])

    def finish(self) -> None:
        """Raises BundleError unless the bundle ended where its bytes ended."""
        if not self._decoder.eof or self._decoder.unused_data:
            raise BundleError("the bundle is cut short, or bytes follow its end: fetch it again")

    def _inflate(self, piece: bytes) -> bytes:
        self._taken += len(piece)
        if self._taken > self._limits.compressed_bytes:
            raise _too_large(self._limits)
        bound = int(self._taken * self._limits.ratio) + _CHUNK
        try:
            content = self._decoder.decompress(piece, bound - self._grown + 1)
        except zlib.error as error:
            raise BundleError(f"the bundle is no zlib stream: {error}") from error
        self._grown += len(content)
        if self._grown > bound or self._decoder.unconsumed_tail:
            raise BundleError(
                f"the bundle grows beyond {bound:,} bytes in its first {self._taken:,}: expected at most "
                f"{self._limits.ratio:g} to 1"
            )
        return content


def _too_large(limits: BundleLimits) -> BundleError:
    return BundleError(
        f"the bundle has over {limits.compressed_bytes:,} bytes: expected at most {limits.compressed_bytes:,}"
    )


def _decompress(data: bytes, limits: BundleLimits) -> bytes:
    inflation = Inflation(limits)
    content = b"".join(inflation.feed(data))
    inflation.finish()
    return content


def _refuse_constant(name: str) -> float:
    raise ValueError(f"found {name}, expected finite numbers only")
