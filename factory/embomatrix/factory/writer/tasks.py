"""The task writer: seeded tasks over what a scene variant holds, in the paper's four categories."""

from __future__ import annotations

import dataclasses
import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Protocol, runtime_checkable

from embomatrix.factory.writer.goals import (
    GoalConjunct,
    GoalContext,
    placement_goal,
    serving_goal,
    switch_goal,
    thermal_goal,
)
from embomatrix.factory.writer.words import sentence
from embomatrix.world.evaluate import render
from embomatrix.world.goal import And, Formula
from embomatrix.world.task import MAX_TABLE, Task, TaskCategory

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import numpy as np

    from embomatrix.factory.admission import TaskRefusal
    from embomatrix.factory.scenes.view import SceneView
    from embomatrix.factory.writer.variant import Variant

    Maker = Callable[[GoalContext], GoalConjunct | None]

ROWS: Final = (16, 24)
"""Rows of an object table, least and most, where the rooms hold enough."""
TRIES: Final = 12
HELDOUT_OF: Final = 4
"""One goal signature in this many belongs to the held-out split."""

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
"""The pieces that make up a goal of each category; those written twice are twice as likely."""


@dataclass(frozen=True, slots=True)
class Draft:
    """A written task, not yet known to be feasible.

    ``about`` are the goal's objects and the appliances that it takes, ``rooms`` the rooms that they are in.
    """

    task: Task
    about: tuple[str, ...]
    rooms: tuple[str, ...]
    signature: str
    transcript: str = ""
    """How the request came about, in Markdown; empty where nobody talked."""


@dataclass(frozen=True, slots=True)
class DraftOrder:
    """One draft that is asked for. The generator decides all that is drawn for it."""

    category: TaskCategory
    task_id: str
    rng: np.random.Generator


class TaskWriter(Protocol):
    """Writes tasks about the things of a variant."""

    def write(
        self,
        variant: Variant,
        view: SceneView,
        category: TaskCategory,
        task_id: str,
        rng: np.random.Generator,
    ) -> Draft | TaskRefusal | None:
        """A task of the category, None when the variant's rooms hold nothing for one. The generator decides all.

        A refusal tells why whoever was asked for a task gave none.
        """
        ...


@runtime_checkable
class BatchTaskWriter(Protocol):
    """A writer that waits for somebody's answers, and so asks for several drafts at once."""

    at_once: int
    """Drafts that are worth asking for together."""

    def write_all(
        self, variant: Variant, view: SceneView, orders: Sequence[DraftOrder]
    ) -> Sequence[Draft | TaskRefusal]:
        """What came of the first so many of the orders, of one at least: a draft, or why there is none."""
        ...


class PlainWriter:
    """Asks for what a goal says in a bounded vocabulary, and no more."""

    def write(
        self,
        variant: Variant,
        view: SceneView,
        category: TaskCategory,
        task_id: str,
        rng: np.random.Generator,
    ) -> Draft | None:
        shop = GoalContext(view, variant, rng)
        pieces = draw_conjuncts(shop, category)
        if not pieces:
            return None
        return draft_of(shop, category, task_id, pieces, sentence([piece.clause for piece in pieces], rng))


def draw_conjuncts(shop: GoalContext, category: TaskCategory) -> list[GoalConjunct]:
    """Pieces that make up a goal of the category; none where the variant's rooms hold nothing for one."""
    recipes = _RECIPES[category]
    for _ in range(TRIES):
        pieces = _drawn(shop, recipes[int(shop.rng.integers(len(recipes)))])
        if pieces:
            return pieces
    return []


def _drawn(shop: GoalContext, recipe: Sequence[Maker]) -> list[GoalConjunct]:
    """One piece by each maker about objects of its own, or none at all."""
    pieces: list[GoalConjunct] = []
    for make in recipe:
        used = frozenset(name for piece in pieces for name in piece.objects)
        piece = make(dataclasses.replace(shop, used=used))
        if piece is None or any(set(piece.types) & set(other.types) for other in pieces):
            return []
        if used & set(piece.objects):
            return []
        pieces.append(piece)
    return pieces


def draft_of(
    shop: GoalContext,
    category: TaskCategory,
    task_id: str,
    pieces: Sequence[GoalConjunct],
    instruction: str,
    transcript: str = "",
) -> Draft:
    """The task that asks for these pieces in these words."""
    view = shop.view
    goal = _conjunction([piece.goal for piece in pieces])
    types = {key: names for piece in pieces for key, names in piece.types.items()}
    needed = dict.fromkeys(name for piece in pieces for name in piece.objects)
    task = Task(
        task_id=task_id,
        scene_id=shop.variant.scene.scene_id,
        instruction=instruction,
        category=category,
        goal=goal,
        goal_bddl=render(goal),
        table=object_table(view, tuple(needed), shop.rng),
        types=types,
        source="writer",
    )
    return Draft(
        task=task,
        about=tuple(needed),
        rooms=tuple(sorted({view.room(name) for name in needed})),
        signature=" ".join(sorted(sign for piece in pieces for sign in piece.signs)),
        transcript=transcript,
    )


def _conjunction(parts: list[Formula]) -> Formula:
    flat: list[Formula] = []
    for part in parts:
        flat += part.parts if isinstance(part, And) else (part,)
    return flat[0] if len(flat) == 1 else And(tuple(flat))


def object_table(view: SceneView, needed: Sequence[str], rng: np.random.Generator) -> tuple[str, ...]:
    """The needed objects with all that they rest on or in, and distractors of the same rooms, shuffled.

    Distractors bring their own hosts along, so a row's place can always be told.
    """
    rows: dict[str, None] = {}

    def add(name: str) -> None:
        rows.update(dict.fromkeys((name, *view.hosts(name))))

    for name in needed:
        add(name)
    rooms = dict.fromkeys(view.room(name) for name in needed)
    others = [name for room in rooms for name in view.in_room.get(room, ())]
    telling = [name for name in others if _is_useful(view, name)]
    wanted = int(rng.integers(ROWS[0], ROWS[1] + 1))
    for name in rng.permutation(telling) if telling else ():
        if len(rows) >= wanted:
            break
        add(str(name))
    table = list(rows)
    return tuple(table[int(index)] for index in rng.permutation(len(table)))[:MAX_TABLE]


def _is_useful(view: SceneView, name: str) -> bool:
    """Whether a plan could have any use for the object: pictures and blinds fill a table with noise."""
    return (
        view.is_portable(name)
        or view.is_surface(name)
        or view.is_container(name)
        or view.is_openable(name)
        or view.is_toggleable(name)
    )


def is_heldout_signature(signature: str, seed: int) -> bool:
    """Whether goals of this signature belong to the held-out split: a fair draw by hash, fixed for a seed."""
    digest = hashlib.sha256(f"{seed} {signature}".encode()).digest()
    return digest[0] % HELDOUT_OF == 0
