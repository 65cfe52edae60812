"""State of the dispatcher: its one owner, with its invariants and the recent history of every rollout."""

from collections import Counter, deque
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field
from typing import Final

from embomatrix.manager.control.commands import ManagerCommand
from embomatrix.manager.control.dispatch.batches import OpenBatches
from embomatrix.manager.control.dispatch.fair_share import RunAccounts
from embomatrix.manager.control.dispatch.leases import LeaseTable
from embomatrix.manager.control.dispatch.queues import PendingQueues
from embomatrix.manager.control.dispatch.records import (
    BatchRecord,
    DispatchPhase,
    LeaseRecord,
    RolloutKey,
    RolloutRecord,
)
from embomatrix.manager.control.events import Event
from embomatrix.manager.control.reputation import Auditor, AuditRules, Opinion
from embomatrix.manager.control.workers import WorkerPool
from embomatrix.rpc.wire.run_log import RolloutStep, RolloutStepKind
from embomatrix.rpc.wire.values import Completed, GroupPolicy, InfraCode, InfraFailure

HISTORY_KEPT: Final = 32_768
"""Steps of all rollouts that ``explain`` can look back on, at about 150 bytes each."""
REASON_CHARS: Final = 200
"""Characters of a reason in the history. A worker's own words may have thousands."""
WITNESSES: Final = 2
"""Workers that must fail to load a scene before the scene itself is to blame."""
LOAD_FAILURES_KEPT: Final = 256
"""Failures to load of one worker that are kept."""
LOAD_FAILURE_MEMORY_S: Final = 60.0
"""A load failure that is not repeated for this long is forgotten, so that a repaired scene gets another try."""


@dataclass(frozen=True, slots=True)
class DispatchLimits:
    """Bounds of the dispatcher; seconds, except for counts."""

    lease_ttl_s: float = 30.0
    """A lease expires when no heartbeat has renewed it for this long."""
    lease_limit_s: float = 180.0
    """A lease expires after this long, however often it is renewed."""
    execute_deadline_s: float = 60.0
    """A worker kills a slot that has executed one plan for this long."""
    rollout_deadline_s: float = 600.0
    """Longest time from submission to outcome."""
    no_capacity_s: float = 60.0
    """A rollout fails after waiting this long while no worker could take it."""
    lone_load_failure_s: float = 10.0
    """A scene that fails to load on the only worker for this long fails its rollouts."""
    steal_after_s: float = 0.05
    """An idle slot may steal a lease that has been queued behind a busy slot for this long."""
    elsewhere_s: float = 5.0
    """A rollout that failed on a worker is kept from it for this long, while there are other workers."""
    max_attempts: int = 3
    hedge_after_s: float = 1.0
    """A rollout may be hedged after this long, and after twice the 95th percentile of its run."""
    hedge_share: float = 0.05
    """Largest share of a run's rollouts that may be hedged."""
    known_after: int = 16
    """Executions of a run after which its slot-time quantiles count."""
    stall_after_s: float = 10.0
    """A running lease is revoked after this long without a step, and five times the 99th percentile of its run."""
    first_stall_s: float = 30.0
    """A running lease of a run whose slot times are not known is revoked after this long without a step."""
    restart_grace_s: float = 5.0
    """A manager that took over waits this long for workers to claim their leases before it re-dispatches them."""
    audit: AuditRules = field(default_factory=AuditRules)


@dataclass(slots=True, eq=False)
class AuditCase:
    """A result under audit and the executions that are compared with it."""

    key: RolloutKey
    held: RolloutRecord | None
    """The rollout while its result is held back; None once it was delivered."""
    check: RolloutRecord
    """Waits, runs, or can be done by no worker at the moment; never DONE."""
    opinions: list[Opinion]
    results: list[Completed]
    """Results of a held rollout, parallel to ``opinions``: one of them will be delivered."""
    disputed: tuple[str, ...] = ()
    """Workers that contradict each other."""
    alone_s: float | None = None
    """Time since which no worker could execute the check."""


@dataclass(slots=True)
class _LoadFailure:
    first_s: float
    last_s: float
    error: str


class LoadFailures:
    """Failures to load of the last minute, by scene and worker."""

    def __init__(self) -> None:
        self._by_scene: dict[str, dict[str, _LoadFailure]] = {}
        self._by_worker: dict[str, dict[str, None]] = {}
        """Scenes that each worker failed to load, the latest failure last."""

    def record(self, scene: str, worker_id: str, error: str, now_s: float) -> None:
        failures = self._by_scene.setdefault(scene, {})
        known = failures.get(worker_id)
        failures[worker_id] = _LoadFailure(known.first_s if known else now_s, now_s, error)
        scenes = self._by_worker.setdefault(worker_id, {})
        scenes.pop(scene, None)
        scenes[scene] = None
        if len(scenes) > LOAD_FAILURES_KEPT:
            self._remove(next(iter(scenes)), worker_id)

    def forget(self, scene: str) -> None:
        for worker_id in tuple(self._by_scene.get(scene, ())):
            self._remove(scene, worker_id)

    def forget_old(self, now_s: float) -> None:
        """Forget the failures that are older than a minute."""
        for scene, failures in tuple(self._by_scene.items()):
            for worker_id, failure in tuple(failures.items()):
                if now_s - failure.last_s > LOAD_FAILURE_MEMORY_S:
                    self._remove(scene, worker_id)

    def _remove(self, scene: str, worker_id: str) -> None:
        for index, key, inner in (
            (self._by_scene, scene, worker_id),
            (self._by_worker, worker_id, scene),
        ):
            del index[key][inner]
            if not index[key]:
                del index[key]

    def scenes(self) -> tuple[str, ...]:
        return tuple(self._by_scene)

    def verdict(self, scene: str, *, live: int, timeout_s: float, now_s: float) -> InfraFailure | None:
        """Return the failure of the scene's rollouts; None while another worker may still load the scene.

        ``live`` workers can try. A scene that all of them failed to load gets ``timeout_s`` from the first failure.
        """
        failures = {
            name: failure
            for name, failure in self._by_scene.get(scene, {}).items()
            if now_s - failure.last_s <= LOAD_FAILURE_MEMORY_S
        }
        if not failures:
            return None
        alone = live <= len(failures) and now_s - min(f.first_s for f in failures.values()) >= timeout_s
        if len(failures) < WITNESSES and not alone:
            return None
        worker_id, failure = max(failures.items(), key=lambda item: item[1].last_s)
        workers = ", ".join(sorted(failures))
        message = f"scene {scene} could not be loaded by {workers}: {failure.error or 'no reason given'}"
        return InfraFailure(InfraCode.SCENE_LOAD_FAILED, message, worker_id)


HistoryEntry = tuple[float, RolloutStepKind, RolloutKey, str, str, type]
"""Step of a rollout: time, kind, rollout, worker, reason, and the event that caused it."""


def steps_of(
    rollout_id: str, history: Sequence[HistoryEntry], batches: Set[tuple[str, str]]
) -> list[RolloutStep]:
    """Return the steps of a rollout, and those of its batch, in order. ``batches`` are its open ones."""
    found = batches | {key[:2] for _, _, key, *_ in history if key.rollout_id == rollout_id}
    return [
        RolloutStep(at_s, kind, key.run_id, key.batch_id, worker_id, reason, cause.__name__)
        for at_s, kind, key, worker_id, reason, cause in history
        if key.rollout_id in (rollout_id, "") and key[:2] in found
    ]


class DispatchState:
    """All that the dispatcher knows. The modules of this package are functions ``(state, …)`` that change it.

    Each rollout without an outcome is in exactly one place: without a record yet (``coming``), waiting in ``queues``,
    under live ``leases``, held by an audit case, or awaited from the workers of a former manager.
    """

    def __init__(
        self, limits: DispatchLimits, *, lease_key: bytes, first_epoch: int = 1, audit_key: bytes = b""
    ) -> None:
        self.limits = limits
        self.now_s = 0.0
        """Time of the event that is being handled."""
        self.cause: Event | None = None
        """The event that is being handled."""
        self.paused = False
        """An operator paused dispatch: no leases are granted."""
        self.pool = WorkerPool()
        self.runs = RunAccounts(limits.known_after)
        self.leases = LeaseTable(
            self.pool,
            self.runs,
            key=lease_key,
            ttl_s=limits.lease_ttl_s,
            limit_s=limits.lease_limit_s,
            first_epoch=first_epoch,
        )
        self.queues = PendingQueues(self.runs.turn)
        self.batches = OpenBatches()
        self.load_failures = LoadFailures()

        self.auditor = Auditor(limits.audit, audit_key)
        self.cases: dict[RolloutKey, AuditCase] = {}

        self.awaited: dict[RolloutKey, RolloutRecord] = {}
        """Restored rollouts that a worker may still hold under a former manager's lease."""
        self.awaited_scenes: Counter[str] = Counter()
        """Scenes of ``awaited``, counted; rollouts that got an outcome meanwhile stay counted until the wait ends."""
        self.awaited_until_s = 0.0
        self.expected_workers: set[str] | None = None
        """Workers of the former manager that have not reported yet; None while unknown."""

        self.hedge_wanted: Mapping[str, tuple[int, float]] = {}
        """Late rollouts that no idle worker can take, and the age of the oldest lease in seconds, by scene."""
        self.unplaceable: dict[str, tuple[float, str]] = {}
        """Time since which no worker can hold a scene, and the reason, by scene."""
        self.no_worker_since_s = 0.0

        self.freed: dict[str, Event | None] = {}
        """Workers that lost a lease during this event, with the cause. Their slots are filled last."""
        self._commands: list[ManagerCommand] = []
        self._history: deque[HistoryEntry] = deque(maxlen=HISTORY_KEPT)

    def emit(self, command: ManagerCommand) -> None:
        """Add a new command to those of the event, which is its cause."""
        object.__setattr__(command, "cause", self.cause)
        self._commands.append(command)

    def take_commands(self) -> list[ManagerCommand]:
        """Return the commands since the last call, in order."""
        commands, self._commands = self._commands, []
        return commands

    def policy_of(self, record: RolloutRecord) -> GroupPolicy:
        """Return the group policy of a rollout. Turns are of many episodes, so none takes others with it."""
        if record.rollout.is_turn:
            return GroupPolicy.PARTIAL
        return self.runs.of(record.key.run_id).terms.group_policy

    def end_lease(self, lease: LeaseRecord) -> None:
        """End a lease. Its slot is filled after the event."""
        self.leases.end(lease, self.now_s)
        self.freed[lease.worker_id] = self.cause

    def log(self, kind: RolloutStepKind, key: RolloutKey, worker_id: str = "", reason: str = "") -> None:
        """Add a step to the history of a rollout, or of all rollouts of a batch for an empty rollout id."""
        self._history.append((self.now_s, kind, key, worker_id, reason[:REASON_CHARS], type(self.cause)))

    def history(self) -> list[HistoryEntry]:
        """Return the recent steps of all rollouts, oldest first."""
        return list(self._history)

    def batches_with(self, rollout_id: str) -> set[tuple[str, str]]:
        """Return run and batch id of the open batches that have this rollout without an outcome."""
        return {(b.run_id, b.batch_id) for b in self.batches if self._open_record(b, rollout_id)}

    def where(self, rollout_id: str) -> str:
        """Return the place of a rollout without an outcome, in words; empty if there is none."""
        for batch in self.batches:
            record = self._open_record(batch, rollout_id)
            if record is None:
                continue
            if record.leases:
                leases = (f"{lease.ref.lease_id} on {lease.worker_id}" for lease in record.leases)
                return f"leased: {', '.join(leases)}"
            if record.held:
                return "executed; another worker checks the result"
            if record.key in self.awaited:
                return "awaited: a worker of the former manager may hold it"
            return f"queued; {self.queues.count(record.scene)} rollouts wait for scene {record.scene}"
        return ""

    @staticmethod
    def _open_record(batch: BatchRecord, rollout_id: str) -> RolloutRecord | None:
        """Return the record that stands for a rollout without an outcome."""
        record = batch.open.get(rollout_id)
        if record is None:
            record = next((r for r in batch.open.values() if rollout_id in r.rollout.also), None)
        return record

    def check_invariants(self) -> None:
        """Raise AssertionError if parts of the state contradict each other. Costs a scan of the whole state."""
        self.pool.check_invariants()
        self.leases.check_invariants()
        self.queues.check_invariants()
        queued = set(self.queues)
        for batch in self.batches:
            assert batch.whole.left, (batch.run_id, batch.batch_id)
            for group in (batch.whole, *batch.groups.values()):
                assert group.waiting == sum(record.count for record in group.open.values())
            for record in batch.open.values():
                places = [
                    record in queued,
                    bool(record.leases),
                    record.held,
                    record.key in self.awaited,
                ]
                assert places.count(True) == 1, (record.key, places)
                assert (record.phase is DispatchPhase.PENDING) == places[0], record.key
                assert record.held == (record.key in self.cases and self.cases[record.key].held is record)
        for case in self.cases.values():
            assert case.check.phase is not DispatchPhase.DONE, case.key
            assert {o.worker_id for o in case.opinions} <= case.check.queue.excluded_workers
        assert not self.freed
