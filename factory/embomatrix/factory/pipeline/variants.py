"""Scene variants: one variant at a time is furnished with small objects, described by tasks, judged and bundled."""

import contextlib
import itertools
import time
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from embomatrix.factory.admission import RefusalReason, TaskRefusal, admit
from embomatrix.factory.faithfulness.instruction import audit
from embomatrix.factory.faithfulness.shortcuts import find_shortcuts, shortcut_in_words
from embomatrix.factory.layout.request import LayoutAgents
from embomatrix.factory.pipeline.settings import BuildSettings
from embomatrix.factory.pipeline.store import Rejection, VariantResult, VariantYield
from embomatrix.factory.pipeline.task_poses import PoseNeeds, SceneSurvey, cache_poses
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.feasibility import SimulatedRobot
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.writer.tasks import (
    BatchTaskWriter,
    Draft,
    DraftOrder,
    PlainWriter,
    TaskWriter,
    is_heldout_signature,
)
from embomatrix.factory.writer.variant import Variant, build_variant
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
from embomatrix.world.goal import Formula
from embomatrix.world.inflation import bundle_digest
from embomatrix.world.scene import Scene
from embomatrix.world.task import TaskCategory

TASKS_PER_VARIANT: Final = 8
"""Number of tasks that a variant should yield."""
MAX_DRAFTS: Final = 14
"""Number of drafts per variant. Some are not admitted."""
WRITE_TRIES: Final = 120
"""Maximum number of tasks written for the drafts. Tasks with signatures of the other split are discarded."""
MAX_EQUAL_SIGNATURES: Final = 2
"""Maximum number of drafts of a variant with one goal signature."""
MAX_ABOUT_A_THING: Final = 3
"""Maximum number of drafts of a variant that demand something of the same thing. Kitchens may hold a single food."""
FOCUS_ROOMS: Final = 3
"""Number of rooms that get small objects and that the variant's tasks are about."""


@dataclass(frozen=True, slots=True)
class VariantOrder:
    """Order for one variant of a base scene. ``rooms`` are those of its split; ``known`` holds keys of existing tasks.

    ``alike`` counts the existing tasks of the base scene by the kind of their goal. ``told`` are the instructions of its tasks
    in this split, in the order of their variants.
    """

    split: str
    number: int
    base: str
    rooms: tuple[str, ...]
    missing: Mapping[TaskCategory, int]
    known: frozenset[str]
    alike: Mapping[str, int] = field(default_factory=dict)
    told: tuple[str, ...] = ()


class VariantMaker:
    """Maker of variants in this process. Placement results are reused between variants.

    ``writer`` replaces the writer of the settings, ``layout`` the rule-based layout agents. ``own`` are base scenes of files
    by name. Each result depends only on these, the settings and the order. Close the maker after use.
    """

    def __init__(
        self,
        settings: BuildSettings,
        writer: TaskWriter | None = None,
        layout: LayoutAgents | None = None,
        own: Mapping[str, Scene] = MappingProxyType({}),
    ) -> None:
        if writer is None:
            writer = PlainWriter()
        self.settings = settings
        self.writer = writer
        self.library = PlacementLibrary()
        self.foresight = ReachabilitySurvey() if settings.reachability else None
        self._layout = layout
        self._bases: dict[str, Scene] = dict(own)

    def make(self, order: VariantOrder) -> VariantYield:
        """Write and judge the tasks of one variant."""
        began = time.process_time()
        seed = self.settings.seed
        if order.base not in self._bases:
            self._bases[order.base] = build_base_scene(order.base, seed=seed)
        base = self._bases[order.base]
        rng = np.random.default_rng(
            np.random.SeedSequence((seed, zlib.crc32(order.split.encode()), order.number))
        )
        focus = _focus(base, order.rooms, order.missing, rng)
        variant = build_variant(
            base, focus, f"{base.base}-{order.split}-{order.number:03d}", rng, self._layout
        )
        result = _VariantWork(variant, order, self).run(rng)
        return replace(result, cpu_s=time.process_time() - began)

    def close(self) -> None:
        self.library.close()


def uniqueness_key(signature: str, instruction: str) -> str:
    """Return the key that must be unique among the tasks of a dataset."""
    return f"{signature}|{instruction}"


def prove(
    simulator: Simulator, draft: Draft, shortcut_plans: int, physics: Simulator | None
) -> Plan | TaskRefusal:
    """Return a plan that reaches the draft's goal, in stepped physics too if given. No plan tried shows a shortcut."""
    plan = admit(simulator, draft.task, find_plan, physics=physics)
    if isinstance(plan, TaskRefusal):
        return plan
    found = find_shortcuts(simulator, draft.task, draft.intent, plan, shortcut_plans)
    if found.shortcuts:
        return TaskRefusal(RefusalReason.SHORTCUT, shortcut_in_words(found, draft.task.table))
    return plan


def record_of(draft: Draft, plan: Plan, digest: str, split: str) -> TaskRecord:
    """Return the record of an admitted draft in the bundle with this digest."""
    return TaskRecord(
        task=draft.task,
        bundle_digest=digest,
        split=split,
        oracle=tuple(plan_to_json(plan)),
        rooms=draft.rooms,
        signature=draft.signature,
        intent=draft.intent,
    )


def _focus(
    base: Scene, rooms: Sequence[str], missing: Mapping[TaskCategory, int], rng: np.random.Generator
) -> tuple[str, ...]:
    """Return the rooms of a variant: a kitchen while kitchen tasks are missing, and random others."""
    types = {room.name: room.type for room in base.rooms}
    order = [str(name) for name in rng.permutation(list(rooms))]
    wants_kitchen = missing[TaskCategory.KITCHEN_OPERATION] > 0
    order.sort(key=lambda name: not (wants_kitchen and types[name] in {"kitchen", "bar"}))
    return tuple(order[:FOCUS_ROOMS])


class DraftCrowd:
    """Drafts of one variant, which limit near-duplicates by goal, whatever the words."""

    def __init__(self) -> None:
        self._goals: set[Formula] = set()
        self._signatures = Counter[str]()
        self._things = Counter[tuple[str, ...]]()

    def has_place(self, draft: Draft) -> bool:
        """True if no draft has the same goal, and few have its signature or demand something of the same thing."""
        return (
            draft.task.goal not in self._goals
            and self._signatures[draft.signature] < MAX_EQUAL_SIGNATURES
            and all(self._things[clause.things] < MAX_ABOUT_A_THING for clause in draft.intent)
        )

    def add(self, draft: Draft) -> None:
        self._goals.add(draft.task.goal)
        self._signatures[draft.signature] += 1
        self._things.update({clause.things for clause in draft.intent})


class _VariantWork:
    """Writing and judging of one variant's tasks."""

    def __init__(self, variant: Variant, order: VariantOrder, maker: VariantMaker) -> None:
        self._variant = variant
        self._order = order
        self._maker = maker
        self._known = set(order.known)
        self._crowd = DraftCrowd()
        self._admitted: list[tuple[Draft, Plan]] = []
        self._rejections: list[Rejection] = []

    def run(self, rng: np.random.Generator) -> VariantYield:
        """Return the variant's records with their bundle. The missing categories take turns."""
        missing = self._order.missing
        scene = self._variant.scene
        with SceneSurvey(scene, self._maker.foresight) as survey:
            with SimulatedRobot(scene, survey.blocks) as robot:
                drafts = self._write(missing, SceneView(scene, robot), rng)
            needs = [PoseNeeds(draft.about, draft.task.table) for draft in drafts]
            poses = cache_poses(
                SceneView(scene), needs, self._maker.library, survey, self._maker.settings.seed
            )
        left = dict(missing)
        bundle = Bundle(scene, {}, poses)
        with contextlib.ExitStack() as stack:
            simulator = stack.enter_context(contextlib.closing(load_simulator(bundle)))
            physics = (
                stack.enter_context(contextlib.closing(physical_simulator(bundle)))
                if self._maker.settings.physical
                else None
            )
            for draft in drafts:
                if len(self._admitted) == TASKS_PER_VARIANT:
                    break
                if left[draft.task.category] > 0 and self._judge(simulator, physics, draft):
                    left[draft.task.category] -= 1
            tasks = {draft.task.task_id: draft.task for draft, _ in self._admitted}
            data = encode_bundle(prepare(Bundle(scene, tasks, poses), simulator.world))
        return VariantYield(self._result(bundle_digest(data)), data, self._transcripts(), self._trees())

    def _write(
        self, missing: Mapping[TaskCategory, int], view: SceneView, rng: np.random.Generator
    ) -> list[Draft]:
        """Return distinct drafts with signatures of this split. The missing categories take turns."""
        wanted = [category for category, count in missing.items() if count > 0]
        drafts: list[Draft] = []
        turns = itertools.islice(itertools.cycle(wanted), WRITE_TRIES)
        while len(drafts) < MAX_DRAFTS and (written := self._written(turns, view, len(drafts), rng)):
            for category, draft in written:
                if isinstance(draft, TaskRefusal):
                    self._reject(category, draft)
                elif draft is not None and self._is_new(draft):
                    named = replace(draft.task, task_id=self._task_id(len(drafts)))
                    drafts.append(replace(draft, task=named))
                    self._known.add(uniqueness_key(draft.signature, draft.task.instruction))
                    self._crowd.add(draft)
        return drafts

    def _written(
        self, turns: Iterator[TaskCategory], view: SceneView, known: int, rng: np.random.Generator
    ) -> list[tuple[TaskCategory, Draft | TaskRefusal | None]]:
        """Write the next draft, or several at once if the writer waits for answers. Empty after the last turn."""
        writer = self._maker.writer
        if not isinstance(writer, BatchTaskWriter):
            return [
                (category, writer.write(self._variant, view, DraftOrder(category, self._task_id(known), rng)))
                for category in itertools.islice(turns, 1)
            ]
        categories = list(itertools.islice(turns, min(writer.at_once, MAX_DRAFTS - known)))
        orders = [
            DraftOrder(category, self._task_id(known + number), each)
            for number, (category, each) in enumerate(
                zip(categories, rng.spawn(len(categories)), strict=True)
            )
        ]
        found = writer.write_all(self._variant, view, orders) if orders else ()
        return list(zip(categories, found, strict=False))

    def _task_id(self, number: int) -> str:
        return f"{self._variant.scene.scene_id}-{number:02d}"

    def _transcripts(self) -> dict[str, str]:
        """Return the transcripts of the admitted tasks by task id."""
        return {draft.task.task_id: draft.transcript for draft, _ in self._admitted if draft.transcript}

    def _trees(self) -> dict[str, Mapping[str, Any]]:
        """Return the layout trees of the admitted tasks' rooms, by task id."""
        trees = self._variant.trees
        return {
            draft.task.task_id: {
                name: node
                for room in draft.rooms
                if room in trees
                for name, node in trees[room].nested().items()
            }
            for draft, _ in self._admitted
        }

    def _is_new(self, draft: Draft) -> bool:
        """True if the signature belongs to this split, and the task is neither known nor like many others."""
        key = uniqueness_key(draft.signature, draft.task.instruction)
        return self._is_in_split(draft.signature) and key not in self._known and self._crowd.has_place(draft)

    def _is_in_split(self, signature: str) -> bool:
        """True if the signature belongs to this split. Without held-out tasks, training has all signatures."""
        settings = self._maker.settings
        if not settings.heldout:
            return True
        return is_heldout_signature(signature, settings.seed) is (self._order.split == "heldout")

    def _judge(self, simulator: Simulator, physics: Simulator | None, draft: Draft) -> bool:
        verdict = self._verdict(simulator, physics, draft)
        if isinstance(verdict, TaskRefusal):
            self._reject(draft.task.category, verdict, draft.task.instruction, draft.task.goal_bddl)
            return False
        self._admitted.append((draft, verdict))
        return True

    def _verdict(self, simulator: Simulator, physics: Simulator | None, draft: Draft) -> Plan | TaskRefusal:
        """Return the plan of an admitted draft. Its words and its goal demand the same, and no plan tried shows otherwise."""
        task = draft.task
        findings = audit(task, draft.intent, SceneView(self._variant.scene))
        if findings:
            return TaskRefusal(RefusalReason.UNFAITHFUL, findings[0])
        return prove(simulator, draft, self._maker.settings.shortcut_plans, physics)

    def _reject(
        self, category: TaskCategory, refusal: TaskRefusal, instruction: str = "", goal: str = ""
    ) -> None:
        self._rejections.append(
            Rejection(
                scene=self._variant.scene.scene_id,
                category=category.value,
                instruction=instruction,
                goal=goal,
                reason=refusal.reason,
                sentence=refusal.sentence,
            )
        )

    def _result(self, digest: str) -> VariantResult:
        records = tuple(record_of(draft, plan, digest, self._order.split) for draft, plan in self._admitted)
        return VariantResult(self._order.split, self._order.number, records, tuple(self._rejections))
