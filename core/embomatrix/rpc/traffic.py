"""Recorded traffic of a trainer: the groups that it submitted, one line of JSON each, for ``embomatrix bench traffic``."""

import time
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Self

import msgspec

from embomatrix.rpc.wire.values import Batch, Rollout
from embomatrix.skills.parse import PlanError, parse_plan, plan_to_lines
from embomatrix.world.task import Profile


class TrafficError(ValueError):
    """Unreadable record. The message names the line."""


class SubmittedGroup(msgspec.Struct, frozen=True):
    """Plans of one task that were submitted together.

    ``at_s`` counts seconds from the first submission. ``plans`` are the distinct plans, one call per line of text, and
    ``members`` holds for each rollout the index of its plan.
    """

    group_id: str
    step: int
    at_s: float
    bundle_digest: str
    task_id: str
    seed: int
    plans: tuple[str, ...]
    members: tuple[int, ...]

    @classmethod
    def each(cls, batch: Batch, at_s: float) -> Iterator[Self]:
        """Yield the record of each group of a batch."""
        groups: dict[str, list[Rollout]] = {}
        for rollout in batch.rollouts:
            groups.setdefault(rollout.group_id, []).append(rollout)
        for number, rollouts in enumerate(groups.values()):
            yield cls._of(f"{batch.batch_id}/{number}", batch.step, rollouts, at_s)

    @classmethod
    def _of(cls, group_id: str, step: int, rollouts: Sequence[Rollout], at_s: float) -> Self:
        first = rollouts[0]
        texts = [plan_to_lines(rollout.plan) for rollout in rollouts]
        plans = {text: index for index, text in enumerate(dict.fromkeys(texts))}
        return cls(
            group_id,
            step,
            round(at_s, 3),
            first.bundle_digest,
            first.task_id,
            first.seed,
            tuple(plans),
            tuple(plans[text] for text in texts),
        )

    def rollouts(self, prefix: str = "") -> tuple[Rollout, ...]:
        """Return the rollouts, whose ids and group start with ``prefix``. Raise TrafficError."""
        try:
            plans = [parse_plan(text, Profile.HOUSEHOLD) for text in self.plans]
        except PlanError as error:
            raise TrafficError(f"group {self.group_id!r} has a plan that can't be read: {error}") from error
        group_id = f"{prefix}{self.group_id}"
        return tuple(
            Rollout(
                f"{group_id}/{number}", group_id, self.bundle_digest, self.task_id, plans[index], self.seed
            )
            for number, index in enumerate(self.members)
        )


class TrafficLog:
    """File that receives every submitted batch. A new log replaces an old file."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("wb")
        self._began_s = time.monotonic()

    def append(self, batch: Batch) -> None:
        for group in SubmittedGroup.each(batch, time.monotonic() - self._began_s):
            self._file.write(msgspec.json.encode(group) + b"\n")

    def close(self) -> None:
        self._file.close()


def read_traffic(lines: Iterable[bytes]) -> Iterator[SubmittedGroup]:
    """Yield the groups of a log. Raise TrafficError for a line that holds none."""
    decoder = msgspec.json.Decoder(SubmittedGroup)
    for number, line in enumerate(lines, start=1):
        try:
            group = decoder.decode(line)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise TrafficError(
                f"line {number} of the traffic is not a submitted group ({error}): record it again with "
                "`embomatrix train --record`"
            ) from error
        if not all(0 <= index < len(group.plans) for index in group.members):
            raise TrafficError(f"line {number} of the traffic has a member without a plan: record it again")
        yield group
