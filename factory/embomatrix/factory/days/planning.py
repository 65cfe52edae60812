"""Plan of a day: people, needs, the scene that is laid out for them, and the drafts of its tasks. Nothing is proved yet."""

from __future__ import annotations

import contextlib
import zlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from embomatrix.factory.admission import RefusalReason, TaskRefusal, admit
from embomatrix.factory.days.drafts import Combination, DayScene, DraftWriter, PlannedTask, combinations_of
from embomatrix.factory.days.laying import lay_out
from embomatrix.factory.language.kinds import is_held_out
from embomatrix.factory.layout.request import LayoutAgents
from embomatrix.factory.pipeline.variants import VariantOrder, uniqueness_key
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.day import draw_needs
from embomatrix.factory.social.household import draw_cast
from embomatrix.factory.social.knowledge import Need, events
from embomatrix.factory.social.values import Cast
from embomatrix.factory.social.wish import WishPredicate
from embomatrix.factory.writer.tasks import Draft
from embomatrix.factory.writer.words import FreshVoice
from embomatrix.sim.planner.oracle import find_plan
from embomatrix.sim.simulation import load_simulator
from embomatrix.world.bundle import Bundle
from embomatrix.world.poses import PoseCache
from embomatrix.world.scene import Scene
from embomatrix.world.task import TaskCategory

NEEDS_OF_DAY: Final = 16
"""Maximum number of needs of one day."""
NEEDS_OF_EVENT: Final = 4
HELD_OUT_SHAPES: Final = 5
"""One in this many goal shapes with several conditions belongs to the held-out split."""
HELD_OUT_NEEDS: Final = 5
"""One in this many needs belongs to the held-out split."""
MOST_ALIKE: Final = 1
"""Maximum number of tasks with one kind of goal in a base scene: the same wish in other words is no new task."""
RARE: Final = frozenset(
    {
        WishPredicate.UNDER,
        WishPredicate.NEXTTO,
        WishPredicate.DUSTY,
        WishPredicate.STAINED,
        WishPredicate.SOAKED,
    }
)
RARE_WEIGHT: Final = 3.0
"""Weight of needs with a predicate that few needs have, so that each skill is needed by one task in twenty."""
FAVOUR: Final = 3.0
"""Weight of needs whose category is missing most, or which belong to the held-out split, relative to others."""


@dataclass(frozen=True, slots=True)
class PlannedDay:
    """Scene of a day with its tasks, and refusals of needs that could not become a draft."""

    scene: Scene
    tasks: tuple[PlannedTask, ...]
    refusals: tuple[TaskRefusal, ...]

    @property
    def drafts(self) -> tuple[Draft, ...]:
        return tuple(each.draft for each in self.tasks)


PlanDay = Callable[[VariantOrder, Scene, int], PlannedDay | TaskRefusal]
"""Planner of a day from its order, the base scene and the seed of the build."""


def people_of(order: VariantOrder, seed: int) -> Cast:
    """Return the people of the order's scene: the same on each of its days."""
    seeds = (seed, zlib.crc32(order.base.encode()), zlib.crc32(order.split.encode()))
    rng = np.random.default_rng(np.random.SeedSequence(seeds))
    return draw_cast(order.base, order.rooms, rng, order.split, seed)


def plan_day(
    order: VariantOrder,
    base: Scene,
    seed: int,
    agents: LayoutAgents | None = None,
    cast: Cast | None = None,
) -> PlannedDay | TaskRefusal:
    """Draw the needs of a day, lay out its scene and write its drafts. Equal arguments give equal days."""
    place = zlib.crc32(f"{order.base} {order.split}".encode())
    rng = np.random.default_rng(np.random.SeedSequence((seed, place, order.number)))
    cast = cast or people_of(order, seed)
    weights = need_weights(order.split, seed, order.missing)
    needs = draw_needs(SceneView(base), cast, NEEDS_OF_DAY, NEEDS_OF_EVENT, rng, weights)
    if not needs:
        return TaskRefusal(
            RefusalReason.NO_SCENE_OBJECT, "no event of the table suits the people and rooms of this place"
        )
    laid = lay_out(day_name(order), [need.wish for need in needs], base, rng, agents)
    if isinstance(laid, TaskRefusal):
        return laid
    laid_out = DayScene(laid.scene, tuple(needs[at] for at in laid.kept), laid.members)
    writer = DraftWriter(laid_out, cast, order.split, seed, FreshVoice(rng, Counter()))
    day, refusals = _met(laid_out, writer)
    tasks: list[PlannedTask] = []
    known, alike = set(order.known), Counter(order.alike)
    for number, combination in enumerate(combinations_of(day, rng)):
        if order.split == "train" and is_held_out_shape(combination, seed):
            continue
        planned = writer.draft(f"{day_name(order)}-{number:02d}", combination)
        if planned is None:
            kinds = ", ".join(need.need.name for need in combination.needs)
            reason = f"no description distinguishes the objects of {kinds} from others in the table"
            refusals.append(TaskRefusal(RefusalReason.UNFAITHFUL, reason))
            continue
        signature = planned.draft.signature
        key = uniqueness_key(signature, planned.draft.task.instruction)
        if key not in known and alike[signature] < MOST_ALIKE:
            known.add(key)
            alike[signature] += 1
            tasks.append(planned)
    return PlannedDay(day.scene, tuple(tasks), tuple(refusals))


def _met(day: DayScene, writer: DraftWriter) -> tuple[DayScene, list[TaskRefusal]]:
    """Return the day with the needs that the oracle meets one by one, and refusals of the others.

    A need that fails alone would take every task along that it is joined to.
    """
    kept: list[int] = []
    refusals: list[TaskRefusal] = []
    with contextlib.closing(load_simulator(Bundle(day.scene, {}, PoseCache()))) as simulator:
        for number, (need, members) in enumerate(zip(day.needs, day.members, strict=True)):
            verdict = admit(simulator, writer.trial(need, members), find_plan, most_held=1.0)
            if isinstance(verdict, TaskRefusal):
                refusals.append(TaskRefusal(verdict.reason, f"{need.need.name}: {verdict.sentence}"))
            else:
                kept.append(number)
    left = DayScene(day.scene, tuple(day.needs[at] for at in kept), tuple(day.members[at] for at in kept))
    return left, refusals


def day_name(order: VariantOrder) -> str:
    """Return the name of a day's scene."""
    return f"{order.base}-{order.split}-{order.number:03d}"


def need_weights(split: str, seed: int, missing: Mapping[TaskCategory, int]) -> dict[str, float]:
    """Return the weight of each need by name: 0 for training if it is held out, and more if its category is missing."""
    most = max(missing.values(), default=0)
    weights: dict[str, float] = {}
    for event in events():
        for need in event.needs:
            held_out = is_held_out(need.name, seed, HELD_OUT_NEEDS)
            weight = 0.0 if held_out and split == "train" else FAVOUR if held_out else 1.0
            rare = any(part.predicate in RARE for part in need.goal)
            scarce = missing.get(_category(need), 0) == most > 0
            weights[need.name] = weight * (RARE_WEIGHT if rare else 1.0) * (FAVOUR if scarce else 1.0)
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
