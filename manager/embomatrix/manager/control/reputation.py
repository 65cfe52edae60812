"""Reputation of workers: choice of the results to audit, comparison of executions, and quarantine.

A worker is on probation until other workers have confirmed ``AuditRules.probation`` of its executions. Later, a share of its
results is compared. A keyed hash of the lease, which the worker cannot predict, selects them. Probation of 50 executions
catches 1 - 0.9^50 = 99.5 % of the workers that falsify a tenth of their results (acceptance test A17).
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Final, NamedTuple

from embomatrix.rpc.wire.values import Completed

PLATFORM: Final = "platform"
"""Name of the platform fingerprint among a worker's versions."""
REWARD_DIGITS: Final = 6
"""Decimal places to which rewards of different platforms are compared: they are sums of the same few terms."""
TEXT_CHARS: Final = 8_192
TEXT_RATIO: Final = 4
"""Texts of one execution may have ``TEXT_RATIO`` times the characters of another's, plus ``TEXT_CHARS``."""
OPINIONS: Final = 3
"""Number of executions after which a case is given up if no two of them agree."""


@dataclass(frozen=True, slots=True)
class AuditRules:
    """Rules for choosing results to audit. Runs that ask for verified results are always audited."""

    probation: int = 50
    """Number of first executions of a new worker that are all compared."""
    share: float = 0.05
    """Share of its later results that is compared."""
    background: bool = False
    """Audit other runs as well: results of workers on probation before delivery, a share of the others after it, on idle
    slots."""
    unconfirmed: int = 32
    """Most leases and unconfirmed results that a worker on probation may have at a time."""
    backlog: int = 4096
    """Most background audits that may wait; further results are not audited."""
    timeout_s: float = 10.0
    """Longest wait while no worker can execute the check."""


@dataclass(frozen=True, slots=True)
class Opinion:
    """Comparable digest of one execution. ``trace`` is compared on equal platforms only."""

    worker_id: str
    platform: Mapping[str, str]
    """Versions of the worker. Without a platform fingerprint among them, ``trace`` is not compared."""
    trace: tuple[str, str, float, float, float]
    """Digests of the trace and of a turn's observation, and the exact three tiers of the reward."""
    facts: str
    """Digest of atoms, success, step failures and the rounded reward."""
    chars: int = 0
    """Length of its texts. A worker that pads them fills the memory of the manager and the trainers."""

    def agrees(self, other: Opinion) -> bool:
        """True if both executions agree in everything that must be equal for equal plans."""
        fewer, more = sorted((self.chars, other.chars))
        if self.facts != other.facts or more > TEXT_RATIO * fewer + TEXT_CHARS:
            return False
        known = bool(self.platform.get(PLATFORM))
        return self.trace == other.trace if known and self.platform == other.platform else True


def opinion_of(worker_id: str, platform: Mapping[str, str], completed: Completed) -> Opinion:
    """Return the comparable part of a result. It has no durations, and only the total length of the sentences."""
    reward = completed.reward
    tiers = (reward.format, reward.relevance, reward.goal)
    facts = (
        [(atom.text, atom.holds) for atom in reward.atoms],
        reward.success,
        [step.failure for step in completed.steps],
        [round(tier, REWARD_DIGITS) for tier in tiers],
    )
    digest = _digest(facts)
    texts = [*completed.final, *(text for step in completed.steps for text in (step.message, step.blocker))]
    observation = completed.observation
    if observation is not None:
        texts += [observation.room, *observation.held, *observation.changes]
        texts += [observation.advice.problem] if observation.advice is not None else []
    trace = (completed.trace_digest, _digest(observation), *tiers)
    return Opinion(worker_id, platform, trace, digest, sum(map(len, texts)))


def _digest(value: object) -> str:
    return hashlib.blake2b(repr(value).encode(), digest_size=16).hexdigest()


class AuditVerdict(NamedTuple):
    """Indices of the right and of the wrong opinions."""

    right: tuple[int, ...]
    wrong: tuple[int, ...]


def judge(opinions: Sequence[Opinion]) -> AuditVerdict | None:
    """Decide a case: two opinions that agree are right, and only an opinion that contradicts both is wrong.

    None if no two opinions agree.
    """
    for one, two in combinations(range(len(opinions)), 2):
        if opinions[one].agrees(opinions[two]):
            others = [at for at in range(len(opinions)) if at not in (one, two)]
            right = [opinions[one], opinions[two]]
            wrong = tuple(at for at in others if not any(opinions[at].agrees(o) for o in right))
            return AuditVerdict(tuple(at for at in range(len(opinions)) if at not in wrong), wrong)
    return None


@dataclass(slots=True)
class Reputation:
    """Audit record of a worker id; it survives sessions."""

    taken: int = 0
    """Results chosen for comparison."""
    agreed: int = 0
    """Executions confirmed by another worker since probation began."""
    audited: int = 0
    disputed: int = 0
    """Contradicted results that wait for a third opinion. Not kept across managers."""
    mismatches: int = 0
    """Audited executions that were wrong."""
    quarantine: str = ""
    """Reason of its quarantine; empty if it is not in quarantine."""


class Auditor:
    """Reputations of all workers. ``key`` is secret: it determines the audited leases."""

    def __init__(self, rules: AuditRules, key: bytes) -> None:
        self.rules = rules
        self.lone = False
        """True if the last result to audit found no second worker."""
        self._key = key
        self._reputations: dict[str, Reputation] = {}
        self._changed: dict[str, None] = {}

    def know(self, reputations: Mapping[str, Reputation]) -> None:
        """Take over reputations from former managers."""
        self._reputations.update(reputations)

    def note(self, *worker_ids: str) -> None:
        """Mark the reputations of these workers as changed."""
        self._changed.update(dict.fromkeys(worker_ids))

    def take_changed(self) -> list[str]:
        """Return the workers whose reputation changed since the last call."""
        changed, self._changed = self._changed, {}
        return list(changed)

    def forget_blank(self, worker_id: str) -> None:
        """Drop an empty record of a worker that left. New names are free, so such records could fill the memory."""
        if self._reputations.get(worker_id) == Reputation():
            del self._reputations[worker_id]

    def of(self, worker_id: str) -> Reputation:
        return self._reputations.setdefault(worker_id, Reputation())

    def wants(self, worker_id: str, lease_id: str, *, verified: bool) -> bool:
        """True if this result should be audited; in a ``verified`` run before its delivery."""
        if not (verified or self.rules.background):
            return False
        reputation = self.of(worker_id)
        if reputation.disputed:
            return True  # its honesty is in doubt, whatever its record
        return self.on_probation(worker_id) or self._drawn(lease_id)

    def on_probation(self, worker_id: str) -> bool:
        """True until enough executions of the worker were confirmed by others."""
        return self.of(worker_id).agreed < self.rules.probation

    def took(self, worker_id: str) -> None:
        """Count a result of the worker that is audited."""
        self.of(worker_id).taken += 1
        self.note(worker_id)

    def agreed(self, worker_id: str) -> None:
        """Count a confirmed execution."""
        self.note(worker_id)
        reputation = self.of(worker_id)
        reputation.agreed += 1
        reputation.audited += 1

    def convict(self, worker_id: str, reason: str) -> None:
        """Count a wrong execution, and put the worker in quarantine."""
        self.note(worker_id)
        reputation = self.of(worker_id)
        reputation.audited += 1
        reputation.mismatches += 1
        reputation.quarantine = reason

    def pardon(self, worker_id: str) -> None:
        """End the quarantine of a worker: it is on probation again."""
        reputation = self._reputations.get(worker_id)
        if reputation is not None and reputation.quarantine:
            self.note(worker_id)
            reputation.taken = reputation.agreed = 0
            reputation.quarantine = ""

    def _drawn(self, lease_id: str) -> bool:
        digest = hashlib.blake2b(lease_id.encode(), key=self._key, digest_size=8).digest()
        return int.from_bytes(digest) < self.rules.share * 2.0**64
