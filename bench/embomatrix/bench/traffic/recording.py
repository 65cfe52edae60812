"""Recorded traffic of a training run with the scenes it needs, and the sample that the package ships.

The sample is made by ``embomatrix bench sample``: a few scenes of a recorded run with all their groups of the first and the
last sixty steps. Scenes of one building differ little, so they are compressed together.
"""

from __future__ import annotations

import json
import lzma
import random
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Final

import msgspec

from embomatrix.bench.engine.workload import PINNED
from embomatrix.bench.report.figures import BenchError
from embomatrix.rpc.traffic import SubmittedGroup, TrafficError, read_traffic
from embomatrix.world.dataset import Dataset, DatasetError
from embomatrix.world.inflation import bundle_digest

GRPO_PREFIX: Final = "step-"
"""Batches of evaluations have other names."""
STEPS: Final = 60
"""Consecutive steps of each phase."""
GROUPS_FILE: Final = "traffic.jsonl.xz"
SCENES_FILE: Final = "traffic_scenes.xz"


@dataclass(frozen=True, slots=True)
class RecordedTraffic:
    """Groups of the first and the last steps of GRPO, and their bundles by digest."""

    early: tuple[SubmittedGroup, ...]
    late: tuple[SubmittedGroup, ...]
    bundles: Mapping[str, bytes]


def sampled_traffic(folder: Path = PINNED) -> RecordedTraffic:
    """Return the sample in a folder; by default the one that the package ships."""
    head, *lines = lzma.decompress((folder / GROUPS_FILE).read_bytes()).splitlines()
    scenes: list[tuple[str, int]] = json.loads(head)
    content = lzma.decompress((folder / SCENES_FILE).read_bytes())
    ends = list(accumulate(size for _, size in scenes))
    # Levels of compression may differ between systems, so the digests are computed again.
    packed = {
        recorded: zlib.compress(content[end - size : end], level=1)
        for (recorded, size), end in zip(scenes, ends, strict=True)
    }
    renamed = {recorded: bundle_digest(data) for recorded, data in packed.items()}
    groups = [
        msgspec.structs.replace(group, bundle_digest=renamed[group.bundle_digest])
        for group in read_traffic(lines)
    ]
    return _phases(groups, {renamed[recorded]: data for recorded, data in packed.items()})


def recorded_traffic(record: Path, dataset: Path) -> RecordedTraffic:
    """Return the traffic in a file of ``embomatrix train --record``, with the bundles of its dataset. Raise BenchError."""
    groups = _grpo_groups(record)
    found = Dataset.load(dataset)
    try:
        bundles = {
            digest: found.bundle_bytes(digest) for digest in sorted({group.bundle_digest for group in groups})
        }
    except DatasetError as error:
        raise BenchError(
            f"{record} is of other scenes than {dataset} ({error}): name the dataset that it was trained on"
        ) from error
    return _phases(groups, bundles)


def save_sample(record: Path, dataset: Path, out: Path, scenes: int, seed: int) -> RecordedTraffic:
    """Write a random sample of a recorded run's scenes with all their groups of both phases, over an earlier sample.

    Raise BenchError.
    """
    whole = recorded_traffic(record, dataset)
    chosen = set(random.Random(seed).sample(sorted(whole.bundles), min(scenes, len(whole.bundles))))
    contents = {digest: zlib.decompress(whole.bundles[digest]) for digest in chosen}
    # Neighbours in the file should be of one building.
    order = sorted(contents, key=lambda digest: contents[digest][:200])
    sample = RecordedTraffic(
        _of_scenes(whole.early, chosen),
        _of_scenes(whole.late, chosen),
        {digest: whole.bundles[digest] for digest in order},
    )
    lines = [json.dumps([(digest, len(contents[digest])) for digest in order]).encode()]
    # A group of a short run may be early and late.
    lines += dict.fromkeys(map(msgspec.json.encode, (*sample.early, *sample.late)))
    out.mkdir(parents=True, exist_ok=True)
    (out / GROUPS_FILE).write_bytes(lzma.compress(b"\n".join(lines), preset=9))
    (out / SCENES_FILE).write_bytes(lzma.compress(b"".join(contents[digest] for digest in order), preset=9))
    return sample


def _grpo_groups(record: Path) -> list[SubmittedGroup]:
    try:
        with record.open("rb") as lines:
            groups = [group for group in read_traffic(lines) if group.group_id.startswith(GRPO_PREFIX)]
    except (OSError, TrafficError) as error:
        raise BenchError(f"no traffic can be read from {record}: {error}") from error
    if not groups:
        raise BenchError(f"{record} has no groups of GRPO: record a run with `embomatrix train --record`")
    return groups


def _phases(groups: Sequence[SubmittedGroup], bundles: Mapping[str, bytes]) -> RecordedTraffic:
    last = max(group.step for group in groups)
    early = tuple(group for group in groups if group.step <= STEPS)
    return RecordedTraffic(early, tuple(group for group in groups if group.step > last - STEPS), bundles)


def _of_scenes(groups: Iterable[SubmittedGroup], scenes: set[str]) -> tuple[SubmittedGroup, ...]:
    return tuple(group for group in groups if group.bundle_digest in scenes)
