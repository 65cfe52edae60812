"""Packed datasets: one file of records and bundles, in which the parts of the corpus ship.

The bundles' contents are compressed together, since scenes of one home are much alike, and compressed again one by one when
the file is unpacked. Their digests can differ between systems, because versions of zlib do; the digest of a part does not.
"""

import hashlib
import json
import lzma
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from embomatrix.world.dataset import Dataset, DatasetError, TaskRecord, record_from_json, record_to_json
from embomatrix.world.inflation import DEFAULT_LIMITS, bundle_digest, decompress

LEVEL: Final = 6
"""Level of compression of the unpacked bundles, that of ``encode_bundle``."""
_DICTIONARY_BYTES: Final = 1 << 26
"""Reach of repetitions: scenes of one home lie within it."""
_FILTERS: Final = [
    {"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME, "dict_size": _DICTIONARY_BYTES}
]
_HEAD_BYTES: Final = 64 * 1024 * 1024
"""Maximum size of the records."""


def content_digest(dataset: Dataset) -> str:
    """Digest of a dataset's records and of the content of its bundles, the same on every system. Raises DatasetError.

    Difficulties are not part of it: they depend on the training tasks of other parts.
    """
    hashed = hashlib.sha256()
    for piece in _pieces(dataset, without="difficulty"):
        hashed.update(piece)
    return f"sha256:{hashed.hexdigest()}"


def pack(dataset: Dataset, file: Path) -> str:
    """Write a dataset into one file and return its content digest. Raises DatasetError or OSError."""
    # Beside the file: an interrupted command leaves the old one whole.
    part = file.with_name(f"{file.name}.partial")
    try:
        with lzma.open(part, "wb", filters=_FILTERS) as out:
            for piece in _pieces(dataset):
                out.write(piece)
        part.replace(file)
    finally:
        part.unlink(missing_ok=True)
    return content_digest(dataset)


def read_packed(file: Path) -> tuple[list[TaskRecord], dict[str, bytes], str]:
    """Return the records, the bundles by digest, and the content digest. Raises DatasetError or OSError."""
    bundles: dict[str, bytes] = {}
    try:
        with lzma.open(file, "rb") as packed:
            head: Mapping[str, Any] = json.loads(packed.readline(_HEAD_BYTES))
            hashed = hashlib.sha256(_line(_without(head, "difficulty")))
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
    except (
        ValueError,
        LookupError,
        TypeError,
        AttributeError,
        RecursionError,
        EOFError,
        lzma.LZMAError,
    ) as error:
        raise DatasetError(
            f"{file} is no packed dataset ({error}): install the package again, or pack the dataset again"
        ) from error
    return records, bundles, f"sha256:{hashed.hexdigest()}"


def packed_records(file: Path) -> list[Mapping[str, Any]]:
    """Return the records as JSON values, with numbers for their bundles, without unpacking any bundle."""
    with lzma.open(file, "rb") as packed:
        head: Mapping[str, Any] = json.loads(packed.readline(_HEAD_BYTES))
    records: list[Mapping[str, Any]] = head["records"]
    return records


def _pieces(dataset: Dataset, *, without: str = "") -> Iterator[bytes]:
    """Yield one line of JSON with the records and the size of each bundle's content, then the contents, scene by scene."""
    by_scene = {record.bundle_digest: record.task.scene_id for record in dataset.records}
    digests = sorted(by_scene, key=lambda digest: by_scene[digest])
    contents = {digest: decompress(dataset.bundle_bytes(digest), DEFAULT_LIMITS) for digest in digests}
    number = {digest: at for at, digest in enumerate(digests)}
    records = [
        {**record_to_json(record), "bundle": number[record.bundle_digest]} for record in dataset.records
    ]
    head = {"sizes": [len(contents[digest]) for digest in digests], "records": records}
    yield _line(_without(head, without))
    for digest in digests:
        yield bytes(contents[digest])


def _without(head: Mapping[str, Any], field: str) -> Mapping[str, Any]:
    """Return a head whose records lack a field."""
    records = [{name: value for name, value in record.items() if name != field} for record in head["records"]]
    return {"sizes": head["sizes"], "records": records}


def _line(head: Mapping[str, Any]) -> bytes:
    return json.dumps(head, separators=(",", ":")).encode("ascii") + b"\n"
