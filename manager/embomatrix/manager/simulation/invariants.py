"""Invariants of the manager's commands, checked from outside during a simulation."""

from collections import Counter
from collections.abc import Iterable
from typing import Final

from embomatrix.manager.control.commands import (
    AcknowledgeLease,
    CancelLease,
    DeliverResult,
    FinishBatch,
    GiveLease,
    ManagerCommand,
)
from embomatrix.manager.simulation.network import EventQueue
from embomatrix.rpc.wire.leases import LeaseRef, WorkerState
from embomatrix.rpc.wire.values import (
    Batch,
    Completed,
    GroupPolicy,
    InfraFailure,
    ResidentState,
    RolloutResult,
)

HEDGE_SHARE: Final = 0.05
"""Largest share of rollouts that may be hedged."""


class BrokenInvariantError(Exception):
    """A command broke an invariant; the message names the rollout."""


class InvariantChecker:
    """Sees submissions, executions and commands, and nothing of the manager's state."""

    def __init__(self, queue: EventQueue) -> None:
        self.orphaned_s: list[float] = []
        """Time from the loss of a worker to the next lease of each rollout that it held."""
        self._queue = queue
        self._lost_s: dict[str, float] = {}
        self.submitted = 0
        self.delivered = 0
        self.infra_failures = 0
        self._submitted: dict[tuple[str, str], set[str]] = {}
        self._open: dict[tuple[str, str], set[str]] = {}
        self._cursors: dict[tuple[str, str], int] = {}
        self._epochs: set[int] = set()
        self._workers_of: dict[str, list[str]] = {}
        """Workers with valid leases of each rollout."""
        self.hedges = 0
        self._policies: dict[str, GroupPolicy] = {}
        self._lost_in: set[tuple[str, str]] = set()
        """Groups and batches that lost a rollout to an infrastructure failure."""
        self._held_by: dict[str, dict[str, LeaseRef]] = {}
        """Valid leases by worker and rollout."""
        self._warm: dict[str, set[str]] = {}
        self._rollout_of: dict[LeaseRef, str] = {}
        self._gone: frozenset[str] = frozenset()
        self._executed: set[tuple[str, str]] = set()

    @property
    def complete(self) -> bool:
        """True if every rollout has its outcome and every batch has ended."""
        return not self._open

    @property
    def open_rollouts(self) -> int:
        return self.submitted - self.delivered

    @property
    def open_by_run(self) -> Counter[str]:
        """Rollouts without an outcome, by run."""
        counts: Counter[str] = Counter()
        for (run_id, _), left in self._open.items():
            counts[run_id] += len(left)
        return counts

    def open_run(self, run_id: str, policy: GroupPolicy) -> None:
        self._policies[run_id] = policy

    def submit(self, batch: Batch) -> None:
        key = batch.run_id, batch.batch_id
        ids = {name for rollout in batch.rollouts for name in (rollout.rollout_id, *rollout.also)}
        self._submitted[key] = ids
        self._open[key] = set(ids)
        self.submitted += len(ids)

    def executed(self, rollout_id: str, worker_id: str) -> None:
        """Note an execution whose result left the worker."""
        self._executed.add((rollout_id, worker_id))

    def watch(self, commands: Iterable[ManagerCommand], *, lost: Iterable[str] = ()) -> None:
        """Check commands. The leases of workers that the manager has just ``lost`` are void."""
        # A lease of the first lost worker may be granted to the second before its loss is handled.
        self._gone = frozenset(lost)
        for worker_id in self._gone:
            self._lost_s |= dict.fromkeys(self._held_by.get(worker_id, ()), self._queue.now_s)
        self._forget_all(self._gone)
        for command in commands:
            match command:
                case GiveLease():
                    self._give(command)
                case CancelLease(worker_id, ref) | AcknowledgeLease(worker_id, ref):
                    self._end(worker_id, ref)
                case DeliverResult(run_id, batch_id, result):
                    self._deliver((run_id, batch_id), result)
                case FinishBatch(run_id, batch_id):
                    self._finish((run_id, batch_id))
                case _:
                    pass
        self._forget_all(self._gone)

    def report(self, worker_id: str, state: WorkerState, *, resync: bool) -> None:
        """Note a report before the manager gets it. Leases missing in a first report never reached the worker."""
        self._warm[worker_id] = {
            resident.bundle_digest for resident in state.residents if resident.state is ResidentState.WARM
        }
        if resync:
            kept = {*state.running, *(result.ref for result in state.finished)}
            for rollout_id, ref in list(self._held_by.get(worker_id, {}).items()):
                if ref not in kept:
                    self._forget(rollout_id, worker_id)

    def _give(self, command: GiveLease) -> None:
        rollout_id, worker_id = command.rollout.rollout_id, command.worker_id
        _check(
            command.ref.lease_epoch not in self._epochs, f"epoch {command.ref.lease_epoch} was given twice"
        )
        for name in self._gone.intersection(self._workers_of.get(rollout_id, ())):
            self._forget(rollout_id, name)
        workers = self._workers_of.setdefault(rollout_id, [])
        _check(command.hedge or not workers, f"{rollout_id} has two leases at once")
        _check(not command.hedge or len(workers) == 1, f"{rollout_id} is hedged with {len(workers)} leases")
        _check(worker_id not in workers, f"{rollout_id} has two leases on {worker_id}")
        self.hedges += command.hedge
        _check(
            command.rollout.bundle_digest in self._warm.get(worker_id, ()),
            f"{rollout_id} was leased to {worker_id}, which never reported its scene as warm",
        )
        if rollout_id in self._lost_s:
            self.orphaned_s.append(self._queue.now_s - self._lost_s.pop(rollout_id))
        self._epochs.add(command.ref.lease_epoch)
        workers.append(worker_id)
        self._held_by.setdefault(worker_id, {})[rollout_id] = command.ref
        self._rollout_of[command.ref] = rollout_id

    def _end(self, worker_id: str, ref: LeaseRef) -> None:
        rollout_id = self._rollout_of.pop(ref, "")
        if self._held_by.get(worker_id, {}).get(rollout_id) == ref:
            self._forget(rollout_id, worker_id)

    def _forget_all(self, workers: Iterable[str]) -> None:
        for worker_id in workers:
            for rollout_id in list(self._held_by.get(worker_id, ())):
                self._forget(rollout_id, worker_id)

    def _forget(self, rollout_id: str, worker_id: str) -> None:
        del self._held_by[worker_id][rollout_id]
        self._workers_of[rollout_id].remove(worker_id)
        if not self._workers_of[rollout_id]:
            del self._workers_of[rollout_id]

    def _deliver(self, key: tuple[str, str], result: RolloutResult) -> None:
        rollout_id = result.rollout_id
        for name in (rollout_id, *result.also):
            _check(name in self._submitted.get(key, ()), f"{name} was never submitted")
            _check(name in self._open.get(key, ()), f"{name} was delivered twice")
        cursor = self._cursors.get(key, 0) + 1
        _check(result.cursor == cursor, f"{rollout_id} has cursor {result.cursor}: expected {cursor}")
        self._open[key].difference_update((rollout_id, *result.also))
        self._cursors[key] = cursor
        self.delivered += result.count
        outcome = result.outcome
        if isinstance(outcome, Completed):
            evidence = (rollout_id, outcome.worker_id)
            _check(
                evidence in self._executed,
                f"{rollout_id} has a reward that {outcome.worker_id} never computed",
            )
            _check(
                outcome.trace_digest == rollout_id, f"{rollout_id} has the reward of {outcome.trace_digest}"
            )
        elif isinstance(outcome, InfraFailure):
            _check(not hasattr(outcome, "reward"), f"{rollout_id} failed and has a reward")
            self.infra_failures += result.count
            self._lost_in |= {(key[1], result.group_id), (key[1], "")}
        else:
            policy = self._policies.get(key[0], GroupPolicy.PARTIAL)
            whole = "" if policy is GroupPolicy.FAIL_FAST else result.group_id
            _check(policy is not GroupPolicy.PARTIAL, f"{rollout_id} was cancelled by nobody")
            _check((key[1], whole) in self._lost_in, f"{rollout_id} was cancelled and nothing was lost")

    def _finish(self, key: tuple[str, str]) -> None:
        left = self._open.get(key)
        _check(self.hedges <= HEDGE_SHARE * self.submitted, f"{self.hedges} hedges of {self.submitted}")
        _check(left is not None and not left, f"batch {key[1]} ended with {len(left or ())} rollouts open")
        self._open.pop(key)


def _check(holds: bool, what: str) -> None:
    if not holds:
        raise BrokenInvariantError(what)
