"""A folder of imported assets: one JSON file each, read back when a scene is built."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from embomatrix.factory.importers.model import ModelFileError
from embomatrix.world.asset import Asset
from embomatrix.world.codec import asset_from_json, asset_to_json
from embomatrix.world.json_text import parse_json
from embomatrix.world.records import SceneInvalidError
from embomatrix.world.whole_file import read_whole, write_whole

SUFFIX: Final = ".asset.json"
ASSET_MARK: Final = b'"asset_id"'
"""Part of the first bytes of each file."""
MAX_BYTES: Final = 4 * 1024 * 1024
"""Far more than an asset takes that has as many parts as the engine holds."""


def asset_file(folder: Path, asset: Asset) -> Path:
    """Return the file of an asset in a folder."""
    return folder / f"{asset.asset_id}{SUFFIX}"


def save_asset(folder: Path, asset: Asset) -> Path:
    """Write an asset into a folder, which is made when it is missing, and return its file. Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    path = asset_file(folder, asset)
    write_whole(path, json.dumps(asset_to_json(asset), indent=1).encode())
    return path


def read_assets(folder: Path) -> Mapping[str, Asset]:
    """Assets of a folder by their id. Raises ModelFileError naming the file that is missing or damaged."""
    if not folder.is_dir():
        raise ModelFileError(f"{folder} is not a folder: expected one with files that end in {SUFFIX}")
    found: dict[str, Asset] = {}
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        try:
            asset = asset_from_json(parse_json(read_whole(path, at_most=MAX_BYTES)))
        except (OSError, ValueError, SceneInvalidError) as error:
            raise ModelFileError(
                f"{path} is not a readable asset ({error}): import the model again"
            ) from None
        found[asset.asset_id] = asset
    if not found:
        raise ModelFileError(f"{folder} contains no file that ends in {SUFFIX}: import a model into it first")
    return found
