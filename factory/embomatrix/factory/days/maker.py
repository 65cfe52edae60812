"""Maker of days: one scene for the needs of a day, the tasks that they cause, and the proof of each task."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Final

from embomatrix.factory.admission import SEED, RefusalReason, TaskRefusal
from embomatrix.factory.days.planning import MOST_ALIKE, PlanDay, PlannedDay, day_name, plan_day
from embomatrix.factory.days.proofs import DayProofs
from embomatrix.factory.pipeline.build import Making
from embomatrix.factory.pipeline.settings import BuildSettings
from embomatrix.factory.pipeline.store import Rejection, VariantResult, VariantYield
from embomatrix.factory.pipeline.task_poses import PoseNeeds, SceneSurvey, cache_poses
from embomatrix.factory.pipeline.variants import VariantOrder, prove, record_of
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.task_import.neighbours import neighbours_of
from embomatrix.factory.writer.tasks import Draft
from embomatrix.scripts.greedy import greedy_plan
from embomatrix.sim.executor import Simulator
from embomatrix.sim.live_world import prepare
from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.prompt import situation_of
from embomatrix.skills.syntax import Plan
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.goal import And
from embomatrix.world.inflation import bundle_digest
from embomatrix.world.poses import PoseCache
from embomatrix.world.scene import Scene

SPATIAL: Final = frozenset(
    {
        FailureReason.NO_PATH,
        FailureReason.NO_STANDING_POSE,
        FailureReason.OUT_OF_REACH,
        FailureReason.TOO_HIGH,
        FailureReason.NO_LINE_OF_APPROACH,
        FailureReason.DOOR_BLOCKED,
        FailureReason.NO_FREE_POSE,
        FailureReason.PLACES_OUT_OF_REACH,
        FailureReason.PLACES_BEHIND_DOOR,
    }
)
"""Failures for lack of space."""


class DayMaker:
    """Maker of days in this process. A result depends only on the settings and the order. Close the maker after use.

    ``plan`` replaces the rule-based planner of days. ``own`` are base scenes of files by name. ``proofs`` is an earlier
    build, as a folder or packed, whose tasks are proved already if only their words differ.
    """

    def __init__(
        self,
        settings: BuildSettings,
        plan: PlanDay = plan_day,
        own: Mapping[str, Scene] = MappingProxyType({}),
        proofs: Path | None = None,
    ) -> None:
        """Raise DatasetError if ``proofs`` holds no build with the same settings of proof."""
        self._settings = settings
        self._plan = plan
        self._proofs = None if proofs is None else _proofs_in(proofs, settings)
        self._library = PlacementLibrary()
        self._foresight = ReachabilitySurvey() if settings.reachability else None
        self._bases: dict[str, Scene] = dict(own)

    def make(self, order: VariantOrder) -> VariantYield:
        """Plan a day and prove its tasks."""
        began = time.process_time()
        if order.base not in self._bases:
            self._bases[order.base] = build_base_scene(order.base, seed=self._settings.seed)
        planned = self._plan(order, self._bases[order.base], self._settings.seed)
        made = self._made(order, planned)
        return replace(made, cpu_s=time.process_time() - began)

    def _made(self, order: VariantOrder, planned: PlannedDay | TaskRefusal) -> VariantYield:
        work = _DayWork(order, self._settings, self._library, self._foresight)
        if isinstance(planned, TaskRefusal):
            return work.refused(planned)
        retold = self._proofs.retold(planned, order) if self._proofs is not None else None
        return retold or work.run(planned)

    def close(self) -> None:
        self._library.close()


TASKS_PER_DAY: Final = 2
"""Number of tasks that a day should yield. With the analysis of the arm and the proof in physics, many needs drop out."""
MOST_OF_CATEGORY: Final = 0.5
"""Largest share of a category: the needs of people are not the same number in each."""
DAYS: Final = Making(
    DayMaker, whole_scenes=True, tasks=TASKS_PER_DAY, most=MOST_OF_CATEGORY, alike=MOST_ALIKE
)
"""Making of days in whole scenes."""


def _proofs_in(path: Path, settings: BuildSettings) -> DayProofs:
    """Read an earlier build. Raise DatasetError if it has other settings of proof."""
    proofs = DayProofs(path)
    proofs.check(settings)
    return proofs


def days_with_proofs(path: Path, settings: BuildSettings) -> Making:
    """Return the making of days with the proofs of an earlier build: tasks that differ only in words are not proved again.

    Raise DatasetError if there is no build with the same settings of proof, here rather than in a process of the build.
    """
    _proofs_in(path, settings)
    return replace(DAYS, begin=partial(DayMaker, proofs=path))


def days_planned_by(plan: PlanDay) -> Making:
    """Return a making of days with another planner. Equal planners give equal days."""
    return replace(DAYS, begin=partial(DayMaker, plan=plan))


class _DayWork:
    """Writing and proof of one day's tasks."""

    def __init__(
        self,
        order: VariantOrder,
        settings: BuildSettings,
        library: PlacementLibrary,
        foresight: ReachabilitySurvey | None,
    ) -> None:
        self._order = order
        self._settings = settings
        self._library = library
        self._foresight = foresight
        self._admitted: list[tuple[Draft, Plan]] = []
        self._rejections: list[Rejection] = []

    def refused(self, refusal: TaskRefusal) -> VariantYield:
        """Return the result of a day without a scene."""
        self._reject("", "", "", refusal)
        return VariantYield(self._result(""), b"", {})

    def run(self, planned: PlannedDay) -> VariantYield:
        """Return the day's records with their bundle."""
        for refusal in planned.refusals:
            self._reject("", "", "", refusal)
        bundle = Bundle(planned.scene, {}, self._poses(planned))
        left = dict(self._order.missing)
        with contextlib.ExitStack() as stack:
            simulator = stack.enter_context(contextlib.closing(load_simulator(bundle)))
            physics = None
            if self._settings.physical:
                physics = stack.enter_context(contextlib.closing(physical_simulator(bundle)))
            for draft in planned.drafts:
                if left.get(draft.task.category, 0) > 0 and self._judge(simulator, physics, draft):
                    left[draft.task.category] -= 1
            tasks = {draft.task.task_id: draft.task for draft, _ in self._admitted}
            data = encode_bundle(prepare(Bundle(planned.scene, tasks, bundle.poses), simulator.world))
        transcripts = {draft.task.task_id: draft.transcript for draft, _ in self._admitted}
        return VariantYield(self._result(bundle_digest(data)), data, transcripts)

    def _poses(self, planned: PlannedDay) -> PoseCache:
        view = SceneView(planned.scene)
        needs = [
            PoseNeeds(
                draft.about,
                draft.task.table,
                neighbours_of(draft.task.goal, draft.task.types, view.is_portable),
            )
            for draft in planned.drafts
        ]
        with SceneSurvey(planned.scene, self._foresight) as survey:
            return cache_poses(view, needs, self._library, survey, self._settings.seed)

    def _judge(self, simulator: Simulator, physics: Simulator | None, draft: Draft) -> bool:
        verdict = self._verdict(simulator, physics, draft)
        if isinstance(verdict, TaskRefusal):
            task = draft.task
            self._reject(task.category.value, task.instruction, task.goal_bddl, verdict)
            return False
        self._admitted.append((draft, verdict))
        return True

    def _verdict(self, simulator: Simulator, physics: Simulator | None, draft: Draft) -> Plan | TaskRefusal:
        plan = prove(simulator, draft, self._settings.shortcut_plans, physics)
        if isinstance(plan, TaskRefusal):
            return plan
        return self._hidden_obstacle(simulator, draft) or plan

    def _hidden_obstacle(self, simulator: Simulator, draft: Draft) -> TaskRefusal | None:
        """Return a refusal if a plain plan for the goal, in one order or the other, fails for lack of space.

        A policy that understands the words must not fail because one of two orders of placing leaves no room.
        """
        task = draft.task
        atoms = tuple(atom for atom, _ in task.goal_atoms)
        situation = situation_of(simulator.world.scene, task)
        for order in (atoms, atoms[::-1]):
            plan = greedy_plan(replace(task, goal=And(order)), situation)
            trace = simulator.execute(task, plan, SEED)
            if trace.failure in SPATIAL:
                sentence = (
                    f"a plain plan for the goal fails, and no prompt shows why: {trace.steps[-1].message}"
                )
                return TaskRefusal(RefusalReason.HIDDEN_OBSTACLE, sentence)
        return None

    def _reject(self, category: str, instruction: str, goal: str, refusal: TaskRefusal) -> None:
        rejection = Rejection(
            day_name(self._order), category, instruction, goal, refusal.reason, refusal.sentence
        )
        self._rejections.append(rejection)

    def _result(self, digest: str) -> VariantResult:
        records = tuple(record_of(draft, plan, digest, self._order.split) for draft, plan in self._admitted)
        return VariantResult(self._order.split, self._order.number, records, tuple(self._rejections))
