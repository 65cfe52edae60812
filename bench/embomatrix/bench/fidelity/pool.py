"""Process pool that executes trials in both modes, scene by scene. A process that dies or hangs costs its current trial.

Children are spawned, never forked, because the parent may hold threads and a loaded engine.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import time
import traceback
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from embomatrix.sim.fidelity.compare import FidelityTrial, compare, comparison_to_json, trial_to_json
from embomatrix.world.dataset import Dataset

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from multiprocessing.connection import Connection
    from multiprocessing.process import BaseProcess
    from pathlib import Path

    from embomatrix.sim.executor import Simulator
    from embomatrix.world.bundle import Bundle

    Load = Callable[[Bundle], Simulator]

JOIN_S: Final = 5.0
LOST: Final = "lost"
"""Key of the reason in the result line of a lost trial."""


@dataclass(frozen=True, slots=True)
class Modes:
    """Functions that load a scene in each mode. They are pickled by name, so they must belong to a module."""

    cached: Load
    physical: Load


@dataclass(frozen=True, slots=True)
class TrialJob:
    """Trials of one bundle."""

    bundle_digest: str
    trials: tuple[FidelityTrial, ...]


class FidelityPool:
    """Runs jobs in dedicated processes. ``limit_s`` bounds the time for loading a scene and for each trial."""

    def __init__(self, folder: Path, modes: Modes, processes: int, limit_s: float) -> None:
        self._folder = folder
        self._modes = modes
        self._processes = processes
        self._limit_s = limit_s
        self._spawn = multiprocessing.get_context("spawn")

    def run(self, jobs: Sequence[TrialJob], on_result: Callable[[Mapping[str, Any]], None]) -> None:
        """Execute every trial once. ``on_result`` gets a JSON value for each: a comparison, or a lost trial."""
        waiting = deque(job for job in jobs if job.trials)
        busy: list[_Child] = []
        try:
            while waiting or busy:
                while waiting and len(busy) < self._processes:
                    busy.append(_Child(self._start(), waiting.popleft(), self._limit_s))
                soonest = min(child.deadline for child in busy)
                multiprocessing.connection.wait(
                    [child.connection for child in busy], max(0.0, soonest - time.monotonic())
                )
                for child in tuple(busy):
                    rest = child.receive(on_result)
                    if rest is not None:
                        busy.remove(child)
                        child.stop()
                        if rest.trials:
                            waiting.appendleft(rest)
        finally:
            for child in busy:
                child.stop()

    def _start(self) -> tuple[BaseProcess, Connection]:
        ours, theirs = self._spawn.Pipe()
        process = self._spawn.Process(
            target=_serve, args=(theirs, self._folder, self._modes), daemon=True, name="fidelity"
        )
        process.start()
        theirs.close()
        return process, ours


class _Child:
    """One process and its remaining trials."""

    def __init__(self, started: tuple[BaseProcess, Connection], job: TrialJob, limit_s: float) -> None:
        self._process, self.connection = started
        self._digest = job.bundle_digest
        self._left = deque(job.trials)
        self._limit_s = limit_s
        self.deadline = time.monotonic() + limit_s
        self.connection.send(job)

    def receive(self, on_result: Callable[[Mapping[str, Any]], None]) -> TrialJob | None:
        """Read results. Return the rest of the job if the process has to be replaced, None while it works."""
        try:
            while self.connection.poll():
                value = self.connection.recv()
                self._left.popleft()
                self.deadline = time.monotonic() + self._limit_s
                on_result(value)
                if LOST in value:
                    return TrialJob(self._digest, tuple(self._left))
        except (EOFError, ConnectionError):
            return self._lose("the process died", on_result)
        if not self._left:
            return TrialJob(self._digest, ())
        if time.monotonic() >= self.deadline:
            return self._lose(f"no answer in {self._limit_s:g} s", on_result)
        return None

    def stop(self) -> None:
        self.connection.close()
        self._process.terminate()
        self._process.join(JOIN_S)
        if self._process.is_alive():
            self._process.kill()

    def _lose(self, reason: str, on_result: Callable[[Mapping[str, Any]], None]) -> TrialJob:
        if self._left:
            on_result({**trial_to_json(self._left.popleft()), LOST: reason})
        return TrialJob(self._digest, tuple(self._left))


def _serve(connection: Connection, folder: Path, modes: Modes) -> None:
    """Load the job's scene in both modes and send the result of each trial."""
    job: TrialJob = connection.recv()
    trial = job.trials[0]
    try:
        bundle = Dataset.load(folder).read_bundle(job.bundle_digest)
        cached, physical = modes.cached(bundle), modes.physical(bundle)
        for trial in job.trials:
            comparison = compare(cached, physical, bundle.tasks[trial.task_id], trial)
            connection.send(comparison_to_json(comparison))
    except Exception:  # noqa: BLE001 -- any exception of a mode is a finding, reported with its trial
        connection.send({**trial_to_json(trial), LOST: traceback.format_exc(limit=-6)})
