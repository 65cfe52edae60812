"""Who is believed: which results are executed a second time, whether executions agree, and who was found to be wrong.

Pure decisions. A worker is on probation until ``AuditRules.probation`` of its executions were compared with another's; of
the others a share is compared, chosen by a keyed hash of the lease, so that a worker can't tell which. The reference for
both numbers is A17: 1 - 0.9^50 = 99.5 % of workers that lie on a tenth of their rollouts are caught on probation.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from enum import Enum, auto
from itertools import combinations
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from embomatrix.rpc.wire.values import Completed

PLATFORM: Final = "platform"
"""The version by which a worker names the fingerprint of its platform."""
REWARD_DIGITS: Final = 6
"""Rewards of two platforms are compared to so many decimal places: they are sums of the same few terms."""
OPINIONS: Final = 3
"""After so many executions without two that agree, nobody knows what is right."""


@dataclass(frozen=True, slots=True)
class AuditRules:
    """What is executed twice. Results of runs that ask for verified ones are, whatever ``background`` says."""

    probation: int = 50
    """So many executions of a new worker are compared, all of them."""
    share: float = 0.05
    """Of its later results."""
    background: bool = False
    """Audit other runs as well, after delivery and on slots that nobody else wants."""
    backlog: int = 4096
    """Such audits that wait at most; results beyond it are not audited."""
    patience_s: float = 10.0
    """How long an audit waits while there is no worker that could do it."""


@dataclass(frozen=True, slots=True)
class Opinion:
    """What one execution came to. Within a platform all of it is comparable, across platforms only ``facts``."""

    worker_id: str
    platform: Mapping[str, str]
    """Versions of the worker; without a fingerprint it is like no other."""
    trace: tuple[str, float, float, float]
    """Digest of the trace, and the three tiers of the reward, to the bit."""
    facts: str
    """Digest of atoms, success, outcomes of the steps and the rounded reward."""

    def agrees(self, other: Opinion) -> bool:
        """Whether both executions came to the same, as far as equal plans must."""
        if self.facts != other.facts:
            return False
        known = bool(self.platform.get(PLATFORM))
        return self.trace == other.trace if known and self.platform == other.platform else True


def opinion_of(worker_id: str, platform: Mapping[str, str], completed: Completed) -> Opinion:
    """What to compare of a result: words and durations are left out."""
    reward = completed.reward
    tiers = (reward.format, reward.relevance, reward.goal)
    facts = (
        [(atom.text, atom.holds) for atom in reward.atoms],
        reward.success,
        [step.failure for step in completed.steps],
        [round(tier, REWARD_DIGITS) for tier in tiers],
    )
    digest = hashlib.blake2b(repr(facts).encode(), digest_size=16).hexdigest()
    return Opinion(worker_id, platform, (completed.trace_digest, *tiers), digest)


class Ruling(Enum):
    """What opinions come to."""

    OPEN = auto()
    """Another execution has to tell."""
    AGREED = auto()
    SPLIT = auto()
    """All of them differ."""


@dataclass(frozen=True, slots=True)
class AuditVerdict:
    """``right`` and ``wrong`` are places in the list of opinions; both are empty unless it was agreed."""

    ruling: Ruling
    right: tuple[int, ...] = ()
    wrong: tuple[int, ...] = ()


def judge(opinions: Sequence[Opinion]) -> AuditVerdict:
    """Two that agree are right. Wrong is only who contradicts both of them: without that nobody is blamed."""
    for one, two in combinations(range(len(opinions)), 2):
        if opinions[one].agrees(opinions[two]):
            others = [at for at in range(len(opinions)) if at not in (one, two)]
            right = [opinions[one], opinions[two]]
            wrong = tuple(at for at in others if not any(opinions[at].agrees(o) for o in right))
            return AuditVerdict(
                Ruling.AGREED, tuple(at for at in range(len(opinions)) if at not in wrong), wrong
            )
    return AuditVerdict(Ruling.SPLIT if len(opinions) >= OPINIONS else Ruling.OPEN)


@dataclass(slots=True)
class Repute:
    """What is known of a worker, by its id: a new session changes nothing."""

    taken: int = 0
    """Results of it that are or were compared."""
    agreed: int = 0
    """Executions of it with which another agreed, since it was put on probation."""
    audited: int = 0
    disputed: int = 0
    """Results of it that another contradicts and that a third has to tell about; what a former manager left open is not."""
    mismatches: int = 0
    """Of those audited: in which it was found to be wrong."""
    quarantine: str = ""
    """Why it gets nothing more; empty for all others."""


class Auditor:
    """Keeps the reputes. ``key`` is secret: whoever knows it knows which leases are audited."""

    def __init__(self, rules: AuditRules, key: bytes) -> None:
        self.rules = rules
        self.lone = False
        """A result was not audited because there was no second worker."""
        self._key = key
        self._reputes: dict[str, Repute] = {}
        self._changed: dict[str, None] = {}

    def know(self, reputes: Mapping[str, Repute]) -> None:
        """What former managers found out."""
        self._reputes.update(reputes)

    def note(self, *worker_ids: str) -> None:
        """There is more to be noted of these workers."""
        self._changed.update(dict.fromkeys(worker_ids))

    def take_changed(self) -> list[str]:
        """Workers whose repute changed since this was last asked."""
        changed, self._changed = self._changed, {}
        return list(changed)

    def of(self, worker_id: str) -> Repute:
        return self._reputes.setdefault(worker_id, Repute())

    def quarantined(self, worker_id: str) -> str:
        """Why the worker gets nothing; empty if it does."""
        found = self._reputes.get(worker_id)
        return found.quarantine if found is not None else ""

    def wants(self, worker_id: str, lease_id: str, *, verified: bool) -> bool:
        """Whether this result is compared with a second one; for a ``verified`` run before it is delivered."""
        if not (verified or self.rules.background):
            return False
        repute = self.of(worker_id)
        if repute.disputed:
            return True  # that it is honest is in doubt, however many of its results are known by now
        known = repute.agreed if verified else repute.taken
        return known < self.rules.probation or self._drawn(lease_id)

    def took(self, worker_id: str) -> None:
        """A result of it is to be compared."""
        self.of(worker_id).taken += 1
        self.note(worker_id)

    def agreed(self, worker_id: str) -> None:
        """Others came to what it came to."""
        self.note(worker_id)
        repute = self.of(worker_id)
        repute.agreed += 1
        repute.audited += 1

    def convict(self, worker_id: str, reason: str) -> None:
        """A majority contradicts it."""
        self.note(worker_id)
        repute = self.of(worker_id)
        repute.audited += 1
        repute.mismatches += 1
        repute.quarantine = reason

    def pardon(self, worker_id: str) -> None:
        """An operator takes it back: it is on probation again."""
        repute = self._reputes.get(worker_id)
        if repute is not None and repute.quarantine:
            self.note(worker_id)
            repute.taken = repute.agreed = 0
            repute.quarantine = ""

    def _drawn(self, lease_id: str) -> bool:
        digest = hashlib.blake2b(lease_id.encode(), key=self._key, digest_size=8).digest()
        return int.from_bytes(digest) < self.rules.share * 2.0**64
