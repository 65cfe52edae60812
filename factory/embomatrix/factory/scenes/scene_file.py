"""Scene files, as written by ``scene build``. Files are untrusted and checked in every part when read."""

import json
from pathlib import Path
from typing import Final

from embomatrix.world.codec import scene_from_json, scene_to_json
from embomatrix.world.json_text import parse_json
from embomatrix.world.records import SceneInvalidError
from embomatrix.world.scene import Scene
from embomatrix.world.whole_file import read_whole, write_whole

SUFFIX: Final = ".json"
MAX_BYTES: Final = 64 * 1024 * 1024
"""Upper limit for a scene file, more than ten times the largest base scene."""
SCENE_MARKS: Final = (b'"scene_id"', b'"base"')
"""Parts of the first bytes of each scene file."""


class SceneFileError(ValueError):
    """File that can't be used as a scene. The message names the file, what was found and what was expected."""


def write_scene(path: Path, scene: Scene) -> None:
    """Write a scene as JSON. Raises OSError."""
    write_whole(path, json.dumps(scene_to_json(scene)).encode("utf-8"))


def read_scene(path: Path) -> Scene:
    """Read and check the scene in a file of at most MAX_BYTES. Raises SceneFileError."""
    if not path.is_file():
        raise _unusable(path, "is not a file")
    try:
        return scene_from_json(parse_json(read_whole(path, at_most=MAX_BYTES)))
    except OSError as error:
        raise _unusable(path, f"can't be read ({error.strerror})") from error
    except SceneInvalidError as error:
        raise _unusable(path, f"is not a scene ({error})") from error
    except ValueError as error:
        raise _unusable(path, f"is not JSON ({error})") from error


def _unusable(path: Path, problem: str) -> SceneFileError:
    return SceneFileError(f"{path} {problem}: expected a file that `embomatrix scene build` wrote")
