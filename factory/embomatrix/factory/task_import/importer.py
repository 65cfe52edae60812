"""Importer of problems in this process or in several processes."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import StrEnum

from embomatrix.factory.admission import RefusalReason, TaskRefusal
from embomatrix.factory.metrics.figures import EvaluationError
from embomatrix.factory.scenes.base_scenes import BaseScenes
from embomatrix.factory.task_import.batch import Imported, bind_first, verify_first
from embomatrix.factory.task_import.report import ProblemOutcome, outcome_of, unparsable_outcome
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.factory.task_import.task import ImportedTask, ImportOptions
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.sim.process_pool import shared_work
from embomatrix.world.bddl import BddlError

ImportOutcome = tuple[ProblemOutcome, Imported | None]
"""Outcome of a problem, for the report and as a value. Bound tasks stay in the process that made them."""
ImportMany = Callable[[Sequence[SourceText]], Iterator[ImportOutcome]]
"""Function that imports problems and yields the outcomes in order."""


class Depth(StrEnum):
    """Depth of an import."""

    VERIFY = "verify"  # bound, and solved by the oracle in the simulator
    BIND = "bind"  # bound to a scene, with a goal within the skills' reach
    INSTANTIATE = "instantiate"  # bound to a scene, with any goal


@dataclass(frozen=True, slots=True)
class ImportSettings:
    """Settings that decide the imports of one command."""

    scenes: BaseScenes
    seed: int
    depth: Depth
    reachability: bool


class ProblemImporter:
    """Importer with loaded base scenes and a placement library. Close it after use."""

    def __init__(self, settings: ImportSettings) -> None:
        self._settings = settings
        self._bases = settings.scenes.built_all()
        self._foresight = ReachabilitySurvey() if settings.reachability else None
        self._library = PlacementLibrary()

    def run(self, source: SourceText) -> ImportOutcome:
        """Import one problem. Text that is no BDDL is refused, so that the other problems are imported."""
        try:
            item = self._imported(source)
        except BddlError as error:
            refusal = TaskRefusal(RefusalReason.UNPARSABLE, str(error))
            return unparsable_outcome(source, refusal.sentence), refusal
        scenes = self._settings.scenes
        return outcome_of(source, item, scenes.names, scenes.own), item

    def _imported(self, source: SourceText) -> Imported:
        seed = self._settings.seed
        match self._settings.depth:
            case Depth.INSTANTIATE:
                return bind_first(source, self._bases, seed=seed, options=ImportOptions(reachable=False))
            case Depth.BIND:
                return bind_first(source, self._bases, seed=seed)
            case Depth.VERIFY:
                return verify_first(source, self._bases, self._library, self._foresight, seed=seed)

    def close(self) -> None:
        self._library.close()


def importing(settings: ImportSettings, jobs: int) -> AbstractContextManager[ImportMany]:
    """Return a context with a function that imports problems. Raise EvaluationError if a process dies."""
    died = EvaluationError(
        "a process that imports problems died, possibly for lack of memory: run the same command with fewer --jobs"
    )
    work = ProblemImporter.run if jobs == 1 else _picklable_import
    return shared_work(jobs, ProblemImporter, work, settings, died=died)


def _picklable_import(importer: ProblemImporter, source: SourceText) -> ImportOutcome:
    """Import one problem in another process, and drop bound tasks from the outcome."""
    outcome, item = importer.run(source)
    return outcome, None if isinstance(item, ImportedTask) else item
