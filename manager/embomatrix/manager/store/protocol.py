"""State store: runs, batches, results, credentials and worker state that a later manager needs.

Leases are not stored: the workers that hold them report them.
"""

import contextlib
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol

from google.protobuf.message import DecodeError


class StateError(Exception):
    """Unusable store. The message names the store and a remedy."""


class StateFullError(StateError):
    """Full store: nothing was written. Submissions must wait for free space."""


class FencedError(StateError):
    """Another manager took the store over: this one must stop dispatching."""


@contextlib.contextmanager
def readable(row: str) -> Iterator[None]:
    """Turn an error of reading stored bytes into StateError. ``row`` names them in its message."""
    try:
        yield
    except (DecodeError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise StateError(
            f"{row} in the state store can't be read ({error}): it is damaged, or of another version; restore the store from "
            "a backup, or pass another --state"
        ) from error


class PutOutcome(StrEnum):
    """Result of storing a batch."""

    CREATED = "created"
    SAME = "same"
    """The batch was stored before with the same content."""
    CONFLICT = "conflict"
    """The id is taken by other content."""
    NO_RUN = "no_run"


@dataclass(frozen=True, slots=True)
class Candidate:
    """Candidate for leadership."""

    holder: str
    """Stable across restarts, so that a restarted manager need not wait for its own leader lease to lapse."""
    address: str
    """Address for workers and trainers."""
    ttl_s: float
    """Life of a leader lease without renewal, in seconds."""


@dataclass(frozen=True, slots=True)
class Lead:
    """Current leader and epoch; ``mine`` if it is the candidate."""

    epoch: int
    address: str
    mine: bool


@dataclass(frozen=True, slots=True)
class RunRow:
    """Run; ``terms`` is opaque to the store."""

    run_id: str
    name: str
    terms: bytes = b""


@dataclass(frozen=True, slots=True)
class BatchRow:
    """Submitted batch; ``payload`` is opaque to the store, ``digest`` identifies its content."""

    run_id: str
    batch_id: str
    digest: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class ResultRow:
    """Delivered result, opaque to the store. Cursors of a batch rise from 1."""

    cursor: int
    rollout_id: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class BatchResults:
    """Results of one batch that are written together."""

    run_id: str
    batch_id: str
    rows: Sequence[ResultRow]


class Namespace(StrEnum):
    """Named rows beside the runs, for later managers."""

    CREDENTIALS = "credentials"
    """Credentials by token id, with the hash of the secret."""
    REPUTATIONS = "reputes"
    """Audit reputations by worker id."""
    SWITCHES = "switches"
    """Switches of the operator, the id of the data folder, and the secret key of lease ids."""
    WINDOWS = "windows"
    """Last announced look-ahead windows by run id; deleted with the run."""


@dataclass(frozen=True, slots=True)
class NamespaceRow:
    """Named row; ``payload`` is opaque to the store."""

    key: str
    payload: bytes


class StateStore(Protocol):
    """Only the leading manager may write; earlier leaders get FencedError.

    Writes raise StateFullError without free space, and StateError while the store is away.
    """

    async def claim(self, candidate: Candidate) -> Lead:
        """Become the leader under a new, higher epoch, unless another manager leads."""

    async def renew(self) -> None:
        """Renew the leader lease, even if it lapsed. Raises FencedError after another manager took over."""

    async def open_run(self, run: RunRow) -> None:
        """Store a run. A repeated id keeps the first name and terms."""

    async def close_run(self, run_id: str) -> None:
        """Delete a run with its batches, results and window. Unknown ids are ignored."""

    async def put_batch(self, batch: BatchRow) -> PutOutcome:
        """Store a batch if its run is open and its id is free."""

    async def append_results(self, parts: Sequence[BatchResults]) -> int:
        """Store results of several batches in one atomic write. The first result of each rollout counts.

        Returns the number of new results; none of unknown batches.
        """

    async def results_after(self, run_id: str, batch_id: str, cursor: int, limit: int) -> list[ResultRow]:
        """Return results with a higher cursor, in order."""

    async def drop_batch(self, run_id: str, batch_id: str) -> None:
        """Delete a batch and its results."""

    async def runs(self) -> list[RunRow]:
        """Return the open runs, oldest first."""

    async def batches(self, run_id: str) -> list[BatchRow]:
        """Return the batches of a run, oldest first."""

    async def put_workers(self, worker_ids: Collection[str]) -> None:
        """Replace the list of present workers, which a later manager waits for."""

    async def workers(self) -> frozenset[str]:
        """Return the list of present workers."""

    async def put_rows(self, namespace: Namespace, rows: Sequence[NamespaceRow]) -> None:
        """Store rows in one atomic write, replacing rows of the same key."""

    async def rows(self, namespace: Namespace) -> list[NamespaceRow]:
        """Return the latest row of every key, in any order."""

    async def close(self) -> None:
        """Release the leader lease, connections and files."""
