"""Base scenes of a command: names of the catalog, and scenes from files that ``scene build`` wrote."""

import hashlib
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from embomatrix.factory.floorplan.house_file import SUFFIX as HOUSE_SUFFIX
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.scene_file import MAX_BYTES, SUFFIX, SceneFileError, read_scene
from embomatrix.sim.validation import check_scene
from embomatrix.world.catalog import Catalog
from embomatrix.world.codec import scene_to_json
from embomatrix.world.dataset import DatasetError
from embomatrix.world.scene import Scene
from embomatrix.world.whole_file import read_whole, write_whole

SCENES_FOLDER: Final = "scenes"
"""Folder of a dataset with its base scenes that came from files."""
EVERY_SCENE: Final = "all"
_NAME: Final = re.compile(r"\w+\Z", re.ASCII)


@dataclass(frozen=True)
class BaseScenes:
    """Names of base scenes without repetition; ``own`` holds those that were read from files, by name."""

    names: tuple[str, ...]
    own: Mapping[str, Scene] = field(default_factory=dict)

    def built(self, name: str, *, seed: int = 0) -> Scene:
        """Return a scene of a file as it is, or build one of the catalog. Raises CatalogError for an unknown name."""
        return self.own.get(name) or build_base_scene(name, seed=seed)

    def built_all(self, *, seed: int = 0) -> list[Scene]:
        """Return all scenes in the order of their names. Raises CatalogError for an unknown name."""
        return [self.built(name, seed=seed) for name in self.names]

    def only(self, word: str) -> Scene:
        """Return the one scene that a word stands for. Raises SceneFileError for several; CatalogError for an unknown name."""
        if len(self.names) > 1:
            raise SceneFileError(f"--scene {word} stands for {len(self.names)} scenes: name one of them")
        return self.built(self.names[0])

    def room_types(self) -> list[str]:
        """Return the type of each room of all scenes. Raises CatalogError for an unknown name."""
        catalog = Catalog.load()
        return [
            room.type
            for name in self.names
            for room in (self.own[name].rooms if name in self.own else catalog.inventory(name).rooms)
        ]

    def key(self, name: str) -> str:
        """Return the name of a scene, for a file with its content, so that two scenes of one name differ."""
        return f"{name} {scene_digest(self.own[name])}" if name in self.own else name


def base_scenes(requested: Iterable[str]) -> BaseScenes:
    """Read the requested scenes: names of the catalog, "all" for each of these, and files that ``scene build`` wrote.

    Names are not looked up. Raises SceneFileError for a file that can't be used and for two scenes of one name; EngineError
    for a file with a body that physics can't take.
    """
    names: dict[str, str] = {}
    own: dict[str, Scene] = {}
    for word in dict.fromkeys(requested):
        if word.endswith(HOUSE_SUFFIX):
            raise SceneFileError(
                f"{word} is a floor plan: build it with `embomatrix scene build {word}`, and name the file that this writes"
            )
        scene = _own_scene(Path(word)) if word.endswith(SUFFIX) else None
        for name in Catalog.load().scene_ids if word == EVERY_SCENE else (scene.base if scene else word,):
            if name in names and (scene is not None or name in own):
                raise SceneFileError(
                    f"{names[name]} and {word} are both called {name!r}: tasks of different scenes need different "
                    "names; name one of the two"
                )
            names[name] = word
            if scene is not None:
                own[name] = scene
    return BaseScenes(tuple(names), own)


def _own_scene(path: Path) -> Scene:
    scene = read_scene(path)
    if scene.scene_id != scene.base or not _NAME.match(scene.base):
        raise SceneFileError(
            f"{path} holds the scene {scene.scene_id!r} of the base {scene.base!r}: expected a base scene, as "
            "`embomatrix scene build` writes it, with a name of letters, digits and underscores"
        )
    check_scene(scene)
    return scene


def scene_digest(scene: Scene) -> str:
    """Return ``sha256:`` and the digest of a scene's file."""
    return f"sha256:{hashlib.sha256(_encoded(scene)).hexdigest()}"


def keep_scenes(folder: Path, own: Iterable[Scene]) -> None:
    """Write scenes into a dataset's folder, so that it can be built again elsewhere.

    Raises DatasetError if another scene of this name is there; OSError.
    """
    check_scenes_free(folder, own := tuple(own))
    for scene in own:
        path = _kept_file(folder, scene)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, _encoded(scene))


def check_scenes_free(folder: Path, own: Iterable[Scene]) -> None:
    """Raise DatasetError if a dataset's folder holds another scene in the place of one of these; OSError."""
    for scene in own:
        path = _kept_file(folder, scene)
        if path.exists() and read_whole(path, at_most=MAX_BYTES) != _encoded(scene):
            raise DatasetError(
                f"{path} is another scene than the one that the dataset needs: name another folder with --out"
            )


def drop_scenes(folder: Path, own: Iterable[Scene]) -> None:
    """Remove the scenes of these names from an earlier dataset of the same command. Raises OSError."""
    for scene in own:
        _kept_file(folder, scene).unlink(missing_ok=True)


def _kept_file(folder: Path, scene: Scene) -> Path:
    return folder / SCENES_FOLDER / f"{scene.base}{SUFFIX}"


def check_kept(folder: Path, own: Sequence[Scene]) -> None:
    """Raise DatasetError unless an interrupted build in the folder has these scenes of files, and no others."""
    kept = {path.stem: path for path in (folder / SCENES_FOLDER).glob(f"*{SUFFIX}")}
    given = {scene.base: scene for scene in own}
    for name in sorted(kept.keys() | given.keys()):
        if name not in kept:
            raise DatasetError(
                f"{folder} holds a build with the scene {name!r} of the catalog, not of a file: name another folder"
            )
        if name not in given:
            raise DatasetError(
                f"{folder} holds a build with the scene of {kept[name]}: give that file with --scenes, or name another folder"
            )
        if read_whole(kept[name], at_most=MAX_BYTES) != _encoded(given[name]):
            raise DatasetError(
                f"{folder} holds a build with another scene {name!r}, in {kept[name]}: give that file with --scenes, or "
                "name another folder"
            )


def _encoded(scene: Scene) -> bytes:
    return json.dumps(scene_to_json(scene)).encode("utf-8")
