"""Head of a bundle, and the tasks that its JSON names. A manager reads no more of a bundle, and has no numpy."""

import struct
from pathlib import Path
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from embomatrix.world.inflation import DEFAULT_LIMITS, BundleError, BundleLimits, check_values, decompress
from embomatrix.world.task import MAX_NAME, MAX_TASKS, Profile

FORMAT: Final = 3
MAGIC: Final = b"EMBX"
HEAD: Final = struct.Struct("<4sII")
"""Magic, format, number of bytes of JSON."""


class _TaskHead(msgspec.Struct):
    task_id: Annotated[str, Meta(max_length=MAX_NAME)]
    profile: Profile = Profile.PAPER


class _TasksOfBundle(msgspec.Struct):
    tasks: Annotated[list[_TaskHead], Meta(max_length=MAX_TASKS)]


def read_profiles(path: Path, *, limits: BundleLimits = DEFAULT_LIMITS) -> dict[str, Profile]:
    """Return the profile of each task of a bundle file by task id. Scene and arrays are skipped, not built.

    Raises BundleError or OSError.
    """
    with path.open("rb") as file:
        content = decompress(file.read(limits.compressed_bytes + 1), limits)
    if len(content) < HEAD.size or content[:4] != MAGIC:
        raise BundleError(f"it begins with {content[:4]!r}: expected {MAGIC!r}")
    text_bytes = HEAD.unpack_from(content)[2]
    text = memoryview(content)[HEAD.size : HEAD.size + text_bytes]
    check_values(text, limits)
    try:
        found = msgspec.json.decode(text, type=_TasksOfBundle)
    except (ValueError, RecursionError) as error:
        raise BundleError(f"its tasks can't be read: {error}") from error
    return {task.task_id: task.profile for task in found.tasks}
