"""Bundles: a scene, its tasks and its pose cache as one compressed, content-addressed file.

The digest is taken of the compressed bytes, so a receiver checks it before it decompresses anything; the size and the
ratio of decompression are bounded, so a hostile bundle costs nothing but its transfer.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from embomatrix.world.codec import scene_from_json, scene_to_json
from embomatrix.world.codec_task import poses_from_json, poses_to_json, task_from_json, task_to_json
from embomatrix.world.field import Field, SceneInvalidError
from embomatrix.world.poses import PoseCache

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.world.scene import Scene
    from embomatrix.world.task import Task

FORMAT: Final = 1
_CHUNK: Final = 1 << 20


class BundleError(ValueError):
    """A bundle can't be accepted. The message tells what was found and what was expected."""


@dataclass(frozen=True, slots=True)
class BundleLimits:
    """What a bundle may cost before it is known to be sound."""

    compressed_bytes: int = 8 * 1024 * 1024
    ratio: float = 100.0
    """Decompressed bytes for each compressed byte; JSON of scenes needs about ten."""


@dataclass(frozen=True, slots=True)
class Bundle:
    """What a worker needs to execute plans in a scene. ``tasks`` maps a task's id to the task."""

    scene: Scene
    tasks: Mapping[str, Task]
    poses: PoseCache = field(default_factory=PoseCache)


DEFAULT_LIMITS: Final = BundleLimits()


def encode_bundle(bundle: Bundle) -> bytes:
    """Compressed bytes: equal bundles give equal bytes. Raises BundleError for a task of another scene."""
    _check_tasks(bundle)
    value = {
        "format": FORMAT,
        "scene": scene_to_json(bundle.scene),
        "tasks": [task_to_json(bundle.tasks[task_id]) for task_id in sorted(bundle.tasks)],
        "poses": poses_to_json(bundle.poses),
    }
    text = json.dumps(value, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    return zlib.compress(text.encode("ascii"), level=6)


def bundle_digest(data: bytes) -> str:
    """Content address of a bundle: ``sha256:`` and the hash of its compressed bytes in hexadecimal digits."""
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def decode_bundle(data: bytes, *, digest: str = "", limits: BundleLimits = DEFAULT_LIMITS) -> Bundle:
    """The bundle, checked in every part. ``digest`` is compared first unless it is empty. Raises BundleError."""
    if len(data) > limits.compressed_bytes:
        raise BundleError(f"the bundle has {len(data)} bytes: expected at most {limits.compressed_bytes}")
    found = bundle_digest(data)
    if digest and found != digest:
        raise BundleError(f"the bundle's digest is {found}, expected {digest}")
    try:
        value = json.loads(_decompress(data, limits), parse_constant=_refuse_constant)
        fields = Field(value, "bundle").record("format", "scene", "tasks", "poses")
        if fields["format"].integer() != FORMAT:
            fields["format"].fail(f"found {fields['format'].value}: this version reads {FORMAT}")
        tasks = [task_from_json(item.value) for item in fields["tasks"].items()]
        bundle = Bundle(
            scene=scene_from_json(fields["scene"].value),
            tasks={task.task_id: task for task in tasks},
            poses=poses_from_json(fields["poses"].value),
        )
    except SceneInvalidError as error:
        raise BundleError(f"bundle {found}: {error}") from error
    except (ValueError, RecursionError) as error:
        raise BundleError(f"bundle {found} is no JSON text: {error}") from error
    _check_tasks(bundle)
    return bundle


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


def _decompress(data: bytes, limits: BundleLimits) -> bytes:
    bound = int(len(data) * limits.ratio) + _CHUNK
    decoder = zlib.decompressobj()
    try:
        text = decoder.decompress(data, bound)
    except zlib.error as error:
        raise BundleError(f"the bundle is no zlib stream: {error}") from error
    if decoder.unconsumed_tail:
        raise BundleError(
            f"the bundle of {len(data)} bytes grows beyond {bound} bytes: expected at most {limits.ratio:g} to 1"
        )
    if not decoder.eof or decoder.unused_data:
        raise BundleError("the bundle is cut short, or bytes follow its end: fetch it again")
    return text


def _refuse_constant(name: str) -> float:
    raise ValueError(f"found {name}, expected finite numbers only")
