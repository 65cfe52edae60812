"""Maker of days: one scene for the needs of a day, the tasks that they cause, and the proof of each task."""

from __future__ import annotations

import contextlib
import time
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from embomatrix.factory.admission import RefusalReason, TaskRefusal, admit
from embomatrix.factory.days.drafts import Combination, DraftWriter, combinations_of
from embomatrix.factory.days.laying import DayScene, lay_out
from embomatrix.factory.faithfulness.shortcuts import find_shortcuts, shortcut_in_words
from embomatrix.factory.language.kinds import is_held_out
from embomatrix.factory.pipeline.build import Making
from embomatrix.factory.pipeline.settings import BuildSettings
from embomatrix.factory.pipeline.store import Rejection, VariantResult, VariantYield
from embomatrix.factory.pipeline.task_poses import PoseNeeds, SceneSurvey, cache_poses
from embomatrix.factory.pipeline.variants import VariantOrder, uniqueness_key
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.day import draw_needs
from embomatrix.factory.social.household import draw_cast
from embomatrix.factory.social.knowledge import Need, events
from embomatrix.factory.social.values import Cast
from embomatrix.factory.task_import.neighbours import neighbours_of
from embomatrix.factory.writer.tasks import Draft
from embomatrix.factory.writer.words import FreshVoice
from embomatrix.sim.executor import Simulator
from embomatrix.sim.live_world import prepare
from embomatrix.sim.physical.actor import physical_simulator
from embomatrix.sim.physical.survey import ReachabilitySurvey
from embomatrix.sim.placing.pose_cache import PlacementLibrary
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import plan_to_json
from embomatrix.skills.syntax import Plan
from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.dataset import TaskRecord
from embomatrix.world.inflation import bundle_digest
from embomatrix.world.scene import Scene
from embomatrix.world.task import TaskCategory

NEEDS_OF_DAY: Final = 8
"""Maximum number of needs of one day."""
NEEDS_OF_EVENT: Final = 3
HELD_OUT_SHAPES: Final = 5
"""One in this many goal shapes with several conditions belongs to the held-out split."""
HELD_OUT_NEEDS: Final = 5
"""One in this many needs belongs to the held-out split."""
FAVOUR: Final = 3.0
"""Weight of needs whose category is missing most, or which belong to the held-out split, relative to others."""


class DayMaker:
    """Maker of days in this process. A result depends only on the settings and the order. Close the maker after use."""

    def __init__(self, settings: BuildSettings) -> None:
        self._settings = settings
        self._library = PlacementLibrary()
        self._foresight = ReachabilitySurvey() if settings.look_ahead else None
        self._bases: dict[str, Scene] = {}

    def make(self, order: VariantOrder) -> VariantYield:
        """Draw a day, lay out its scene, and write and prove its tasks."""
        began = time.process_time()
        seed = self._settings.seed
        base = self._base(order.base)
        rng = np.random.default_rng(
            np.random.SeedSequence((seed, zlib.crc32(order.split.encode()), order.number))
        )
        cast = self._cast(order)
        needs = draw_needs(
            SceneView(base),
            cast,
            NEEDS_OF_DAY,
            NEEDS_OF_EVENT,
            rng,
            need_weights(order.split, seed, order.missing),
        )
        name = f"{order.base}-{order.split}-{order.number:03d}"
        day = lay_out(name, needs, base, rng) if needs else _NOTHING
        work = _DayWork(order, self._settings, self._library, self._foresight, cast)
        made = work.refused(name, day) if isinstance(day, TaskRefusal) else work.run(name, day, rng)
        return replace(made, cpu_s=time.process_time() - began)

    def close(self) -> None:
        self._library.close()

    def _base(self, name: str) -> Scene:
        if name not in self._bases:
            self._bases[name] = build_base_scene(name, seed=self._settings.seed)
        return self._bases[name]

    def _cast(self, order: VariantOrder) -> Cast:
        """Return the people of the place: the same on each of its days."""
        seeds = (self._settings.seed, zlib.crc32(order.base.encode()), zlib.crc32(order.split.encode()))
        rng = np.random.default_rng(np.random.SeedSequence(seeds))
        return draw_cast(order.base, order.rooms, rng, order.split, self._settings.seed)


DAYS: Final = Making(DayMaker, whole_scenes=True)
"""Making of days in whole scenes."""
_NOTHING: Final = TaskRefusal(
    RefusalReason.NO_SCENE_OBJECT, "no event of the table suits the people and rooms of this place"
)


def need_weights(split: str, seed: int, missing: Mapping[TaskCategory, int]) -> dict[str, float]:
    """Return the weight of each need by name: 0 for training if it is held out, and more if its category is missing."""
    most = max(missing.values(), default=0)
    weights: dict[str, float] = {}
    for event in events():
        for need in event.needs:
            held_out = is_held_out(need.name, seed, HELD_OUT_NEEDS)
            weight = 0.0 if held_out and split == "train" else FAVOUR if held_out else 1.0
            weights[need.name] = weight * (FAVOUR if missing.get(_category(need), 0) == most > 0 else 1.0)
    return weights


def _category(need: Need) -> TaskCategory:
    predicates = {part.predicate.value for part in need.goal}
    if predicates & {"cooked", "hot", "frozen", "sliced"}:
        return TaskCategory.KITCHEN_OPERATION
    placed, switched = (
        predicates & {"ontop", "inside", "under", "nextto"},
        predicates & {"open", "toggled_on"},
    )
    if placed and switched:
        return TaskCategory.COMPOUND
    return TaskCategory.PICK_AND_PLACE if placed else TaskCategory.APPLIANCE_USE


def is_held_out_shape(combination: Combination, seed: int) -> bool:
    """True if goals of this shape belong to the held-out split. Shapes of one condition belong to both."""
    conditions = [each for need in combination.needs for each in need.wish.conditions]
    shape = " ".join(sorted(f"{each.predicate}:{each.quantity}:{each.holds}" for each in conditions))
    return len(conditions) > 1 and is_held_out(shape, seed, HELD_OUT_SHAPES)


class _DayWork:
    """Writing and proof of one day's tasks."""

    def __init__(
        self,
        order: VariantOrder,
        settings: BuildSettings,
        library: PlacementLibrary,
        foresight: ReachabilitySurvey | None,
        cast: Cast,
    ) -> None:
        self._order = order
        self._settings = settings
        self._library = library
        self._foresight = foresight
        self._cast = cast
        self._admitted: list[tuple[Draft, Plan]] = []
        self._rejections: list[Rejection] = []

    def refused(self, name: str, refusal: TaskRefusal) -> VariantYield:
        """Return the result of a day without a scene."""
        self._reject(name, "", "", "", refusal)
        result = VariantResult(self._order.split, self._order.number, (), tuple(self._rejections))
        return VariantYield(result, b"", {})

    def run(self, name: str, day: DayScene, rng: np.random.Generator) -> VariantYield:
        """Return the day's records with their bundle."""
        drafts = self._drafts(name, day, rng)
        view = SceneView(day.scene)
        needs = [
            PoseNeeds(
                draft.about,
                draft.task.table,
                neighbours_of(draft.task.goal, draft.task.types, view.is_portable),
            )
            for draft in drafts
        ]
        with SceneSurvey(day.scene, self._foresight) as survey:
            poses = cache_poses(view, needs, self._library, survey, self._settings.seed)
        bundle = Bundle(day.scene, {}, poses)
        left = dict(self._order.missing)
        with contextlib.ExitStack() as stack:
            simulator = stack.enter_context(contextlib.closing(load_simulator(bundle)))
            physics = None
            if self._settings.physical:
                physics = stack.enter_context(contextlib.closing(physical_simulator(bundle)))
            for draft in drafts:
                if left.get(draft.task.category, 0) > 0 and self._judge(name, simulator, physics, draft):
                    left[draft.task.category] -= 1
            tasks = {draft.task.task_id: draft.task for draft, _ in self._admitted}
            data = encode_bundle(prepare(Bundle(day.scene, tasks, poses), simulator.world))
        transcripts = {draft.task.task_id: draft.transcript for draft, _ in self._admitted}
        return VariantYield(self._result(bundle_digest(data)), data, transcripts)

    def _drafts(self, name: str, day: DayScene, rng: np.random.Generator) -> list[Draft]:
        """Return the drafts of the day that belong to the split and are new."""
        split, seed = self._order.split, self._settings.seed
        writer = DraftWriter(day, self._cast, split, seed, FreshVoice(rng, Counter()))
        found: list[Draft] = []
        known = set(self._order.known)
        for number, combination in enumerate(combinations_of(day, rng)):
            if split == "train" and is_held_out_shape(combination, seed):
                continue
            draft = writer.draft(f"{name}-{number:02d}", combination)
            if draft is None:
                kinds = ", ".join(need.need.name for need in combination.needs)
                reason = f"no description distinguishes the objects of {kinds} from others in the table"
                self._reject(name, "", "", "", TaskRefusal(RefusalReason.UNFAITHFUL, reason))
                continue
            key = uniqueness_key(draft.signature, draft.task.instruction)
            if key not in known:
                known.add(key)
                found.append(draft)
        return found

    def _judge(self, name: str, simulator: Simulator, physics: Simulator | None, draft: Draft) -> bool:
        verdict = self._verdict(simulator, physics, draft)
        if isinstance(verdict, TaskRefusal):
            task = draft.task
            self._reject(name, task.category.value, task.instruction, task.goal_bddl, verdict)
            return False
        self._admitted.append((draft, verdict))
        return True

    def _verdict(self, simulator: Simulator, physics: Simulator | None, draft: Draft) -> Plan | TaskRefusal:
        plan = admit(simulator, draft.task, find_plan, physics=physics)
        if isinstance(plan, TaskRefusal):
            return plan
        found = find_shortcuts(simulator, draft.task, draft.intent, plan, self._settings.shortcut_plans)
        if found.shortcuts:
            return TaskRefusal(RefusalReason.SHORTCUT, shortcut_in_words(found, draft.task.table))
        return plan

    def _reject(self, scene: str, category: str, instruction: str, goal: str, refusal: TaskRefusal) -> None:
        self._rejections.append(
            Rejection(scene, category, instruction, goal, refusal.reason, refusal.sentence)
        )

    def _result(self, digest: str) -> VariantResult:
        records: Sequence[TaskRecord] = [
            TaskRecord(
                task=draft.task,
                bundle_digest=digest,
                split=self._order.split,
                oracle=tuple(plan_to_json(plan)),
                rooms=draft.rooms,
                signature=draft.signature,
                intent=draft.intent,
            )
            for draft, plan in self._admitted
        ]
        return VariantResult(self._order.split, self._order.number, tuple(records), tuple(self._rejections))
