"""The dataset that ships with the package: ``embomatrix demo`` trains on it, and nobody has to build it first.

One file holds the records and the content of each bundle, compressed together, since scenes of one home are much alike.
Bundles are compressed again when the dataset is unpacked. Their digests can differ between systems, because versions of zlib
do; the digest of the whole file does not.
"""

import hashlib
import json
import lzma
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Final

from embomatrix.world.dataset import Dataset, DatasetError, record_from_json, record_to_json, write_dataset
from embomatrix.world.inflation import DEFAULT_LIMITS, bundle_digest, decompress

ARCHIVE: Final = "tasks.xz"
LEVEL: Final = 6
"""Level of compression of the unpacked bundles, that of ``encode_bundle``."""
_DICTIONARY_BYTES: Final = 1 << 26
"""Reach of repetitions: scenes of one home lie within it."""
_FILTERS: Final = [
    {"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME, "dict_size": _DICTIONARY_BYTES}
]
_HEAD_BYTES: Final = 64 * 1024 * 1024
"""Maximum size of the records."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """Settings from which the shipped dataset was built, as the options of ``embomatrix factory generate``."""

    train: int
    heldout: int
    seed: int
    scenes: tuple[str, ...]


RECIPE: Final = Recipe(
    train=480,
    heldout=120,
    seed=0,
    scenes=(
        "Rs_int",
        "Beechwood_0_int",
        "Merom_0_int",
        "Merom_1_int",
        "Pomaria_0_int",
        "Pomaria_1_int",
        "Benevolence_1_int",
        "Ihlen_0_int",
        "Wainscott_0_int",
        "house_single_floor",
        "office_cubicles_left",
        "hotel_suite_small",
        "grocery_store_cafe",
        "restaurant_diner",
    ),
)
"""Fourteen scenes; two of the ten homes are held out."""


def content_digest(dataset: Dataset) -> str:
    """Digest of a dataset's records and of the content of its bundles, the same on every system. Raises DatasetError."""
    hashed = hashlib.sha256()
    for piece in _pieces(dataset):
        hashed.update(piece)
    return f"sha256:{hashed.hexdigest()}"


def pack(dataset: Dataset, file: Path) -> str:
    """Write a dataset into one file and return its content digest. Raises DatasetError or OSError."""
    hashed = hashlib.sha256()
    with lzma.open(file, "wb", filters=_FILTERS) as out:
        for piece in _pieces(dataset):
            hashed.update(piece)
            out.write(piece)
    return f"sha256:{hashed.hexdigest()}"


def is_shipped(dataset: Dataset) -> bool:
    """Return True if a dataset has the records of the shipped one. Bundles are not compared."""
    with (
        resources.as_file(resources.files("embomatrix.starter") / ARCHIVE) as shipped,
        lzma.open(shipped, "rb") as packed,
    ):
        head: Mapping[str, Any] = json.loads(packed.readline(_HEAD_BYTES))
    found = json.loads(json.dumps([record_to_json(record) for record in dataset.records]))
    return [{**value, "bundle": 0} for value in found] == [
        {**value, "bundle": 0} for value in head["records"]
    ]


def unpack(folder: Path, file: Path | None = None) -> str:
    """Write the shipped dataset, or that of a file, to a folder. Return its content digest. Raises DatasetError or OSError."""
    if file is not None:
        return _unpacked(folder, file)
    with resources.as_file(resources.files("embomatrix.starter") / ARCHIVE) as shipped:
        return _unpacked(folder, shipped)


def _pieces(dataset: Dataset) -> Iterator[bytes]:
    """Yield one line of JSON with the records and the size of each bundle's content, then the contents, scene by scene."""
    by_scene = {record.bundle_digest: record.task.scene_id for record in dataset.records}
    digests = sorted(by_scene, key=lambda digest: by_scene[digest])
    contents = {digest: decompress(dataset.bundle_bytes(digest), DEFAULT_LIMITS) for digest in digests}
    number = {digest: at for at, digest in enumerate(digests)}
    records = [
        {**record_to_json(record), "bundle": number[record.bundle_digest]} for record in dataset.records
    ]
    head = {"sizes": [len(contents[digest]) for digest in digests], "records": records}
    yield json.dumps(head, separators=(",", ":")).encode("ascii") + b"\n"
    for digest in digests:
        yield bytes(contents[digest])


def _unpacked(folder: Path, file: Path) -> str:
    hashed = hashlib.sha256()
    bundles: dict[str, bytes] = {}
    try:
        with lzma.open(file, "rb") as packed:
            line = packed.readline(_HEAD_BYTES)
            hashed.update(line)
            head: Mapping[str, Any] = json.loads(line)
            digests = []
            for size in head["sizes"]:
                content = packed.read(size)
                hashed.update(content)
                data = zlib.compress(content, LEVEL)
                digests.append(bundle_digest(data))
                bundles[digests[-1]] = data
        records = [
            record_from_json({**value, "bundle": digests[value["bundle"]]}) for value in head["records"]
        ]
    except (ValueError, KeyError, TypeError, IndexError, EOFError, lzma.LZMAError) as error:
        raise DatasetError(
            f"{file} is no packed dataset ({error}): install the package again, or pack the dataset again"
        ) from error
    write_dataset(folder, records, bundles)
    return f"sha256:{hashed.hexdigest()}"
