"""Who imports problems: this process, or several."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from enum import StrEnum
from typing import TYPE_CHECKING

from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.task_import.batch import Verified, bind_first, verify_first
from embomatrix.factory.task_import.report import ProblemOutcome, outcome_of
from embomatrix.factory.task_import.task import ImportedTask, Manner
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.sim.process_pool import shared_work

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from embomatrix.factory.admission import TaskRefusal
    from embomatrix.factory.task_import.sources import SourceText

    Judging = Callable[[Sequence[SourceText]], Iterator["ImportOutcome"]]
    """Imports problems; what comes of them comes in their order."""


class Depth(StrEnum):
    """How far an import goes."""

    VERIFY = "verify"  # bound, and solved by the oracle in the simulator
    BIND = "bind"  # bound to a scene, the goal within the skills' reach
    INSTANTIATE = "instantiate"  # bound to a scene, whatever the skills can do


@dataclass(frozen=True, slots=True)
class Docket:
    """What decides the imports of one command."""

    scenes: tuple[str, ...]
    seed: int
    depth: Depth
    look_ahead: bool


@dataclass(frozen=True, slots=True)
class ImportOutcome:
    """What became of a problem, as a report tells it and as a value. What was only bound stays where it was made."""

    outcome: ProblemOutcome
    item: ImportedTask | Verified | TaskRefusal | None


class ProblemImporter:
    """Imports problems one after the other, with the base scenes and a client to settle things in. Close it after use."""

    def __init__(self, docket: Docket) -> None:
        self._docket = docket
        self._bases = [build_base_scene(scene_id) for scene_id in docket.scenes]
        self._foresight = ReachabilitySurvey() if docket.look_ahead else None
        self._library = PlacementLibrary()

    def judge(self, source: SourceText) -> ImportOutcome:
        """Import one problem. Raises BddlError where it is none."""
        item = self._imported(source)
        return ImportOutcome(outcome_of(source, item), item)

    def close(self) -> None:
        self._library.close()

    def _imported(self, source: SourceText) -> ImportedTask | Verified | TaskRefusal:
        seed = self._docket.seed
        match self._docket.depth:
            case Depth.INSTANTIATE:
                return bind_first(source, self._bases, seed=seed, manner=Manner(reachable=False))
            case Depth.BIND:
                return bind_first(source, self._bases, seed=seed)
            case Depth.VERIFY:
                return verify_first(source, self._bases, self._library, self._foresight, seed=seed)


@contextlib.contextmanager
def judging(docket: Docket, jobs: int) -> Iterator[Judging]:
    """For as long as this is held. Raises EvaluationError when one of several processes dies."""
    died = EvaluationError(
        "a process that imports problems died, perhaps for want of memory: call the same command with fewer --jobs"
    )
    with shared_work(
        jobs, ProblemImporter, ProblemImporter.judge if jobs == 1 else _sent, docket, died=died
    ) as judge:
        yield judge


def _sent(judge: ProblemImporter, source: SourceText) -> ImportOutcome:
    """What another process tells."""
    judged = judge.judge(source)
    return ImportOutcome(judged.outcome, None) if isinstance(judged.item, ImportedTask) else judged
