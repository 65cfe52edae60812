"""Closed runs on disk: what each came to, and its events, for people who ask later. The oldest make room."""

from __future__ import annotations

import asyncio
import gzip
import logging
import os
import re
import zlib
from typing import TYPE_CHECKING, Final

from google.protobuf.message import DecodeError

from embomatrix.proto.v1 import admin_service_pb2 as pb
from embomatrix.rpc.wire.rollout import ConvertError, each
from embomatrix.rpc.wire.run_log import (
    run_event_from_proto,
    run_event_to_proto,
    run_summary_from_proto,
    run_summary_to_proto,
)

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from embomatrix.rpc.run_log import RunEvent, RunSummary

logger = logging.getLogger(__name__)

RUNS_KEPT: Final = 50
SUFFIX: Final = ".run.gz"
_RUN_ID: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,127}")


class RunArchive:
    """A folder with one file for each of the ``kept`` runs that were closed last.

    What can't be written or read is said in the log and left out: no run fails for the sake of its history.
    """

    def __init__(self, folder: Path, *, kept: int = RUNS_KEPT) -> None:
        self._folder = folder
        self._kept = kept

    async def keep(self, summary: RunSummary, events: Sequence[RunEvent]) -> None:
        """Write a run that was closed; an earlier one of the same id is replaced."""
        await asyncio.to_thread(self._write, summary, events)

    async def summaries(self) -> list[RunSummary]:
        """What is kept, the run that was closed last first."""
        return await asyncio.to_thread(self._read_all)

    async def load(self, run_id: str) -> tuple[RunSummary, tuple[RunEvent, ...]] | None:
        """A run that is kept; None when there is none of that id."""
        # What callers send becomes a file's name: only what can be a run's id does.
        if not _RUN_ID.fullmatch(run_id):
            return None
        return await asyncio.to_thread(self._read, self._path(run_id))

    def _path(self, run_id: str) -> Path:
        return self._folder / f"{run_id}{SUFFIX}"

    def _write(self, summary: RunSummary, events: Sequence[RunEvent]) -> None:
        message = pb.KeptRun(summary=run_summary_to_proto(summary), events=map(run_event_to_proto, events))
        path = self._path(summary.run.run_id)
        fresh = path.with_suffix(".new")
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            fresh.write_bytes(gzip.compress(message.SerializeToString(), compresslevel=3))
            os.replace(fresh, path)
            for old in self._files()[self._kept :]:
                old.unlink(missing_ok=True)
        except OSError as error:
            logger.warning("history not kept run=%s: %s", summary.run.run_id, error)

    def _files(self) -> list[Path]:
        """The latest first."""
        found = self._folder.glob(f"*{SUFFIX}")
        return sorted(found, key=lambda path: (path.stat().st_mtime_ns, path.name), reverse=True)

    def _read_all(self) -> list[RunSummary]:
        found = (self._read(path) for path in self._files())
        return [entry[0] for entry in found if entry is not None]

    def _read(self, path: Path) -> tuple[RunSummary, tuple[RunEvent, ...]] | None:
        try:
            message = pb.KeptRun.FromString(gzip.decompress(path.read_bytes()))
            return run_summary_from_proto(message.summary), each(
                "events", run_event_from_proto, message.events
            )
        except FileNotFoundError:
            return None
        except (OSError, EOFError, zlib.error, DecodeError, ConvertError) as error:
            logger.warning("history can't be read file=%s: %s", path.name, error)
            return None
