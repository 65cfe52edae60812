"""Scenes in files: what ``scene build`` writes, read again to be shown, drawn and checked. A file is trusted in nothing."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Final

from embomatrix.world.codec import scene_from_json, scene_to_json
from embomatrix.world.records import SceneInvalidError
from embomatrix.world.whole_file import read_whole, write_whole

if TYPE_CHECKING:
    from pathlib import Path

    from embomatrix.world.scene import Scene

SUFFIX: Final = ".json"
MAX_BYTES: Final = 64 * 1024 * 1024
"""More than ten times what the largest base scene takes."""


class SceneFileError(ValueError):
    """A file can't be used as a scene. The message names it, and tells what was found and what was expected."""


def write_scene(path: Path, scene: Scene) -> None:
    """Raises OSError."""
    write_whole(path, json.dumps(scene_to_json(scene)).encode("utf-8"))


def read_scene(path: Path) -> Scene:
    """The scene in a file, checked in every part, and never more of the file than a scene may have. Raises SceneFileError."""
    if not path.is_file():
        raise SceneFileError(f"{path} is no file: expected one that `embomatrix scene build` wrote")
    try:
        return scene_from_json(json.loads(read_whole(path, at_most=MAX_BYTES)))
    except OSError as error:
        raise SceneFileError(
            f"{path} can't be read ({error.strerror}): expected what `embomatrix scene build` wrote"
        ) from error
    except SceneInvalidError as error:
        raise SceneFileError(f"{path}: {error}") from error
    except (ValueError, RecursionError) as error:
        raise SceneFileError(
            f"{path} is no JSON ({error}): expected what `embomatrix scene build` wrote"
        ) from error
