"""What the manager writes down, so that another process of it can go on: runs, batches, delivered results, and what is known
of tokens and workers.

Leases are not among it: the workers that hold them say so when they come back.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence


class StateError(Exception):
    """The store can't be used; the sentence names it and the remedy."""


class StateFullError(StateError):
    """The store has no room: nothing was written. What is submitted must wait until somebody makes room."""


class FencedError(StateError):
    """A newer manager took the store over: this one must stop dispatching."""


class PutOutcome(StrEnum):
    """What became of a batch that was put."""

    CREATED = "created"
    SAME = "same"
    """It was there already, with the same content."""
    CONFLICT = "conflict"
    """Its id is taken by other content."""
    NO_RUN = "no_run"


@dataclass(frozen=True, slots=True)
class Candidate:
    """A manager that would lead."""

    holder: str
    """The same after a restart, so that a manager need not wait for its own former life to lapse."""
    address: str
    """Where workers and trainers reach it."""
    ttl_s: float
    """Its lead lapses when it was not renewed for so long."""


@dataclass(frozen=True, slots=True)
class Lead:
    """Who leads, and under which epoch; ``mine`` when it is the candidate that asked."""

    epoch: int
    address: str
    mine: bool


@dataclass(frozen=True, slots=True)
class RunRow:
    """``terms`` is what the run asked for, opaque to the store."""

    run_id: str
    name: str
    terms: bytes = b""


@dataclass(frozen=True, slots=True)
class BatchRow:
    """A batch as it was submitted: ``payload`` is opaque to the store, ``digest`` that of its content."""

    run_id: str
    batch_id: str
    digest: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class ResultRow:
    """A delivered result, opaque to the store. Cursors of a batch rise from 1."""

    cursor: int
    rollout_id: str
    payload: bytes


@dataclass(frozen=True, slots=True)
class BatchResults:
    """Results of one batch that are written together."""

    run_id: str
    batch_id: str
    rows: Sequence[ResultRow]


class Shelf(StrEnum):
    """What is kept by name beside the runs, for every manager that comes."""

    CREDENTIALS = "credentials"
    """Who may call, by the token's id. They hold no secret, only its hash."""
    REPUTES = "reputes"
    """What is known of workers' honesty, by their ids."""
    SWITCHES = "switches"
    """What operators turned on or off."""
    WINDOWS = "windows"
    """What open runs announced last, by their ids; a run takes it along when it is closed."""


@dataclass(frozen=True, slots=True)
class ShelfRow:
    """One thing that is kept by name; ``payload`` is opaque to the store."""

    key: str
    payload: bytes


class StateStore(Protocol):
    """Every write belongs to the manager that leads; one that led before gets ``FencedError``.

    Writing raises ``StateFullError`` when there is no room, ``StateError`` when the store is away.
    """

    async def claim(self, candidate: Candidate) -> Lead:
        """Become the one manager that writes, under an epoch higher than any before, unless another one leads."""

    async def renew(self) -> None:
        """The lead goes on. ``FencedError`` when another manager took it; that it lapsed meanwhile does no harm."""

    async def open_run(self, run: RunRow) -> None:
        """Note a run; the same id again keeps the first name and terms."""

    async def close_run(self, run_id: str) -> None:
        """Forget the run with its batches, results and window; unknown ids are no error."""

    async def put_batch(self, batch: BatchRow) -> PutOutcome:
        """Note a batch, if its run is open and its id is free."""

    async def append_results(self, parts: Sequence[BatchResults]) -> int:
        """Add results of several batches, all or none, in one write; of each rollout only the first counts.

        Returns how many were new. Of an unknown batch: none.
        """

    async def results_after(self, run_id: str, batch_id: str, cursor: int, limit: int) -> list[ResultRow]:
        """Results with a higher cursor, in order."""

    async def drop_batch(self, run_id: str, batch_id: str) -> None:
        """Forget a batch and its results: nobody will ask for it again."""

    async def runs(self) -> list[RunRow]:
        """Open runs, oldest first."""

    async def batches(self, run_id: str) -> list[BatchRow]:
        """Batches of a run, oldest first."""

    async def put_workers(self, worker_ids: Collection[str]) -> None:
        """Replace the list of workers that are there: whom the next manager waits for."""

    async def workers(self) -> frozenset[str]:
        """The workers of that list."""

    async def put_rows(self, shelf: Shelf, rows: Sequence[ShelfRow]) -> None:
        """Note these, all or none; one of a known key replaces it."""

    async def rows(self, shelf: Shelf) -> list[ShelfRow]:
        """The last of every key that was ever put there, in no order."""

    async def close(self) -> None:
        """Leave the lead to whoever claims it next, and let go of connections and files."""
