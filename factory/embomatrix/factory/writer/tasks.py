"""Task writer: seeded tasks about the objects of a scene variant, in the paper's four categories."""

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np

from embomatrix.factory.admission import TaskRefusal
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.writer.goals import (
    GoalConjunct,
    GoalContext,
    placement_goal,
    serving_goal,
    switch_goal,
    thermal_goal,
)
from embomatrix.factory.writer.variant import Variant
from embomatrix.factory.writer.words import sentence
from embomatrix.world.evaluate import render
from embomatrix.world.goal import And, Formula
from embomatrix.world.intent import IntentClause
from embomatrix.world.task import MAX_TABLE, Task, TaskCategory

Maker = Callable[[GoalContext], GoalConjunct | None]

ROWS: Final = (16, 24)
"""Minimum and maximum number of rows of an object table."""
TRIES: Final = 12
HELDOUT_OF: Final = 4
"""One in this many goal signatures belongs to the held-out split."""

_RECIPES: Final[Mapping[TaskCategory, tuple[tuple[Maker, ...], ...]]] = {
    TaskCategory.PICK_AND_PLACE: (
        (placement_goal,),
        (placement_goal,),
        (placement_goal, placement_goal),
    ),
    TaskCategory.APPLIANCE_USE: (
        (switch_goal,),
        (switch_goal, switch_goal),
        (switch_goal, switch_goal),
    ),
    TaskCategory.KITCHEN_OPERATION: ((thermal_goal,), (thermal_goal,), (serving_goal,)),
    TaskCategory.COMPOUND: (
        (placement_goal, switch_goal),
        (switch_goal, placement_goal),
        (thermal_goal, switch_goal),
        (thermal_goal, placement_goal),
        (serving_goal, switch_goal),
        (placement_goal, placement_goal, switch_goal),
    ),
}
"""Conjuncts of a goal by category. Repeated recipes are twice as likely."""


@dataclass(frozen=True, slots=True)
class Draft:
    """Written task whose feasibility is not yet verified.

    ``intent`` is what its instruction demands. ``about`` lists the goal's objects and the appliances that it needs, ``rooms``
    their rooms.
    """

    task: Task
    about: tuple[str, ...]
    rooms: tuple[str, ...]
    signature: str
    intent: tuple[IntentClause, ...] = ()
    transcript: str = ""
    """Conversation behind the request in Markdown; empty if there is none."""


@dataclass(frozen=True, slots=True)
class DraftOrder:
    """Order for one draft. The random generator decides everything drawn for it."""

    category: TaskCategory
    task_id: str
    rng: np.random.Generator


class TaskWriter(Protocol):
    """Writer of tasks about the objects of a variant."""

    def write(self, variant: Variant, view: SceneView, order: DraftOrder) -> Draft | TaskRefusal | None:
        """Return a task of the category, or None if the variant's rooms hold nothing for one. The generator decides all draws.

        A refusal gives the reason why a language model produced no draft.
        """
        ...


@runtime_checkable
class BatchTaskWriter(Protocol):
    """Writer that waits for answers and therefore requests several drafts at once."""

    at_once: int
    """Number of drafts to request together."""

    def write_all(
        self, variant: Variant, view: SceneView, orders: Sequence[DraftOrder]
    ) -> Sequence[Draft | TaskRefusal]:
        """Return a draft or a refusal for each order; at least for the first one."""
        ...


class PlainWriter:
    """Writer that states the goal in a bounded vocabulary."""

    def write(self, variant: Variant, view: SceneView, order: DraftOrder) -> Draft | None:
        context = GoalContext(view, variant, order.rng)
        conjuncts = draw_conjuncts(context, order.category)
        if not conjuncts:
            return None
        return draft_of(
            context, order, conjuncts, sentence([conjunct.clause for conjunct in conjuncts], order.rng)
        )


def draw_conjuncts(context: GoalContext, category: TaskCategory) -> list[GoalConjunct]:
    """Return the conjuncts of a goal of the category; empty if the variant's rooms hold nothing for one."""
    recipes = _RECIPES[category]
    for _ in range(TRIES):
        conjuncts = _drawn(context, recipes[int(context.rng.integers(len(recipes)))])
        if conjuncts:
            return conjuncts
    return []


def _drawn(context: GoalContext, recipe: Sequence[Maker]) -> list[GoalConjunct]:
    """Return one conjunct per maker, each about different objects, or an empty list."""
    conjuncts: list[GoalConjunct] = []
    for make in recipe:
        used = frozenset(name for conjunct in conjuncts for name in conjunct.objects)
        conjunct = make(dataclasses.replace(context, used=used))
        if conjunct is None or any(set(conjunct.types) & set(other.types) for other in conjuncts):
            return []
        if used & set(conjunct.objects):
            return []
        conjuncts.append(conjunct)
    return conjuncts


def draft_of(
    context: GoalContext,
    order: DraftOrder,
    conjuncts: Sequence[GoalConjunct],
    instruction: str,
    transcript: str = "",
) -> Draft:
    """Return the task with these conjuncts and this instruction."""
    view = context.view
    goal = _conjunction([conjunct.goal for conjunct in conjuncts])
    types = {key: names for conjunct in conjuncts for key, names in conjunct.types.items()}
    needed = dict.fromkeys(name for conjunct in conjuncts for name in conjunct.objects)
    task = Task(
        task_id=order.task_id,
        scene_id=context.variant.scene.scene_id,
        instruction=instruction,
        category=order.category,
        goal=goal,
        goal_bddl=render(goal),
        table=object_table(view, tuple(needed), context.rng),
        types=types,
        source="writer",
    )
    return Draft(
        task=task,
        about=tuple(needed),
        rooms=tuple(sorted({view.room(name) for name in needed})),
        signature=" ".join(sorted(sign for conjunct in conjuncts for sign in conjunct.signs)),
        intent=tuple(clause for conjunct in conjuncts for clause in conjunct.intent),
        transcript=transcript,
    )


def _conjunction(parts: list[Formula]) -> Formula:
    flat: list[Formula] = []
    for part in parts:
        flat += part.parts if isinstance(part, And) else (part,)
    return flat[0] if len(flat) == 1 else And(tuple(flat))


def object_table(
    view: SceneView, needed: Sequence[str], rng: np.random.Generator, *, elsewhere: bool = False
) -> tuple[str, ...]:
    """Return the needed objects with their supports, and distractors of the same rooms, shuffled.

    Distractors are added with their supports, so the place of each row can always be stated. With ``elsewhere``, objects of
    other rooms fill a table that the same rooms leave short.
    """
    rows: dict[str, None] = {}

    def add(name: str) -> None:
        rows.update(dict.fromkeys((name, *view.hosts(name))))

    for name in needed:
        add(name)
    wanted = int(rng.integers(ROWS[0], ROWS[1] + 1))
    near = dict.fromkeys(view.room(name) for name in needed)
    far = [room.name for room in view.scene.rooms if room.name not in near] if elsewhere else []
    for rooms in ([*near], far):
        others = [name for room in rooms for name in view.in_room.get(room, ())]
        telling = [name for name in others if _is_useful(view, name)]
        for name in rng.permutation(telling) if telling else ():
            if len(rows) >= wanted:
                break
            add(str(name))
    table = list(rows)
    return tuple(table[int(index)] for index in rng.permutation(len(table)))[:MAX_TABLE]


def _is_useful(view: SceneView, name: str) -> bool:
    """True if a plan can use the object. Pictures and blinds would only add noise."""
    return (
        view.is_portable(name)
        or view.is_surface(name)
        or view.is_container(name)
        or view.is_openable(name)
        or view.is_toggleable(name)
    )


def is_heldout_signature(signature: str, seed: int) -> bool:
    """True if goals of this signature belong to the held-out split: a hash draw that is fixed for a seed."""
    digest = hashlib.sha256(f"{seed} {signature}".encode()).digest()
    return digest[0] % HELDOUT_OF == 0
