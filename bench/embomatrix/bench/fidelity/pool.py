"""Process pool that executes trials in both modes, scene by scene. A process that dies or hangs costs its current trial.

Each thread runs the trials of one bundle in a spawned process, which keeps the loaded scene from trial to trial.
"""

from __future__ import annotations

import functools
import os
import threading
import traceback
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from embomatrix.bench.cluster.processes import kill_tree
from embomatrix.sim.fidelity.compare import FidelityTrial, compare, comparison_to_json, trial_to_json
from embomatrix.sim.process_pool import process_pool
from embomatrix.world.bundle import Bundle
from embomatrix.world.dataset import Dataset

if TYPE_CHECKING:
    from embomatrix.sim.executor import Simulator

    Load = Callable[[Bundle], Simulator]

OnResult = Callable[[Mapping[str, Any]], None]

LOST: Final = "lost"
"""Key of the reason in the result line of a lost trial."""


@dataclass(frozen=True, slots=True)
class Modes:
    """Functions that load a scene in each mode. They are pickled by name, so they must belong to a module."""

    cached: Load
    physical: Load


class FidelityPool:
    """Runs jobs in dedicated processes. ``limit_s`` bounds the time for loading a scene and running a trial."""

    def __init__(self, folder: Path, modes: Modes, processes: int, limit_s: float) -> None:
        self._folder = folder
        self._modes = modes
        self._processes = processes
        self._limit_s = limit_s
        self._stopped = False

    def run(self, jobs: Sequence[Sequence[FidelityTrial]], on_result: OnResult) -> None:
        """Execute every trial once; the trials of a job are of one bundle.

        ``on_result`` gets a JSON value for each: a comparison, or a lost trial.
        """
        lock = threading.Lock()

        def deliver(value: Mapping[str, Any]) -> None:
            with lock:
                on_result(value)

        with ThreadPoolExecutor(self._processes) as threads:
            try:
                for _ in threads.map(functools.partial(self._run_job, deliver=deliver), jobs):
                    pass
            finally:
                self._stopped = True
                threads.shutdown(wait=False, cancel_futures=True)

    def _run_job(self, trials: Sequence[FidelityTrial], deliver: OnResult) -> None:
        waiting = deque(trials)
        while waiting and not self._stopped:
            with process_pool(1) as pool:
                pid = pool.submit(os.getpid).result()
                lost = ""
                while waiting and not lost and not self._stopped:
                    trial = waiting.popleft()
                    try:
                        done = pool.submit(_execute, self._folder, self._modes, trial)
                        deliver(done.result(self._limit_s))
                    except BrokenProcessPool:
                        lost = "the process died"
                    except TimeoutError:
                        lost = f"no answer in {self._limit_s:g} s"
                        kill_tree(pid)
                    except Exception as error:  # noqa: BLE001 -- any exception of a mode is a finding, reported with its trial
                        lost = "".join(traceback.format_exception(error, limit=-6))
                if lost:
                    deliver({**trial_to_json(trial), LOST: lost})


def _execute(folder: Path, modes: Modes, trial: FidelityTrial) -> dict[str, Any]:
    bundle, cached, physical = _load(folder, modes, trial.bundle_digest)
    return comparison_to_json(compare(cached, physical, bundle.tasks[trial.task_id], trial))


@functools.lru_cache(maxsize=1)
def _load(folder: Path, modes: Modes, digest: str) -> tuple[Bundle, Simulator, Simulator]:
    """Load the scene in both modes, once in a process."""
    bundle = Dataset.load(folder).read_bundle(digest)
    return bundle, modes.cached(bundle), modes.physical(bundle)
