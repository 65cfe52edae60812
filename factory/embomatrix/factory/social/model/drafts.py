"""Drafts of requests about the objects that a scene variant already has.

A wish may name objects that a scene lacks. Requests whose objects the variant lacks are refused here.
"""

from collections.abc import Mapping, Sequence
from typing import Final

from embomatrix.factory.admission import RefusalReason, RefusedError, TaskRefusal
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.model.writer import CONCURRENT_DIALOGUES, SEEDS, ModelWriter
from embomatrix.factory.social.rules.wish_rules import is_negative
from embomatrix.factory.social.scene_kinds import kinds_of
from embomatrix.factory.social.wish import FLOOR, Condition, Quantity, Wish, WishedObjects, goal_of
from embomatrix.factory.social.written import WrittenRequest
from embomatrix.factory.writer.categories import category_of
from embomatrix.factory.writer.tasks import Draft, DraftOrder, object_table
from embomatrix.factory.writer.variant import Variant
from embomatrix.world.evaluate import render
from embomatrix.world.intent import IntentClause
from embomatrix.world.state import State
from embomatrix.world.task import Task

Members = Mapping[str, tuple[str, ...]]
_READ: Final = frozenset({State.OPEN, State.TOGGLED_ON})
"""States that a variant sets."""


class VariantModelWriter:
    """Task writer for scene variants on a language model: the requests of a variant's people about what is there."""

    at_once = CONCURRENT_DIALOGUES

    def __init__(self, writer: ModelWriter) -> None:
        self._writer = writer

    def write(self, variant: Variant, view: SceneView, order: DraftOrder) -> Draft | TaskRefusal | None:
        """Return one draft or a refusal; None if the model asked for nothing. Raise LlmError as the writer does."""
        return next(iter(self.write_all(variant, view, [order])), None)

    def write_all(
        self, variant: Variant, view: SceneView, orders: Sequence[DraftOrder]
    ) -> list[Draft | TaskRefusal]:
        """Return a draft or a refusal for each order. The goal decides the category, not the order.

        Raise LlmError as the writer does.
        """
        scene = kinds_of(view, variant.rooms)
        seed = int(orders[0].rng.integers(SEEDS))
        found: list[Draft | TaskRefusal] = []
        for request in self._writer.write(scene, len(orders), seed)[: len(orders)]:
            order = orders[len(found)]
            found.append(
                draft_of(request, variant, view, order) if isinstance(request, WrittenRequest) else request
            )
        return found


def draft_of(
    request: WrittenRequest, variant: Variant, view: SceneView, order: DraftOrder
) -> Draft | TaskRefusal:
    """Return the request as a task about objects of the variant, or the reason why they do not fit."""
    try:
        members = _members(request.wish, variant, view)
    except RefusedError as error:
        return error.refusal
    goal = goal_of(request.wish.conditions, members, {})
    needed = tuple(dict.fromkeys(name for label in request.wish.wanted for name in members[label]))
    task = Task(
        task_id=order.task_id,
        scene_id=variant.scene.scene_id,
        instruction=request.instruction,
        category=category_of(goal),
        goal=goal,
        goal_bddl=render(goal),
        table=object_table(view, needed, order.rng),
    )
    intent = tuple(clause for condition in request.wish.conditions for clause in _clauses(condition, members))
    rooms = tuple(sorted({view.room(name) for name in needed}))
    return Draft(task, needed, rooms, request.signature, intent, request.transcript())


def _members(wish: Wish, variant: Variant, view: SceneView) -> dict[str, tuple[str, ...]]:
    """Return the objects of each group that a condition is about or that holds one. Raise RefusedError."""
    counted = {Quantity.EXACTLY, Quantity.PAIRED}
    parts = [part for condition in wish.conditions for part in condition.parts()]
    if any(part.quantity in counted or part.provided or part.otherwise for part in parts):
        raise RefusedError(
            RefusalReason.INEXPRESSIBLE, "a variant's goal takes no counts, alternatives or premises"
        )
    members: dict[str, tuple[str, ...]] = {}
    taken: set[str] = set()
    for group in wish.objects:
        if group.decoy and group.label not in wish.wanted:
            continue
        found = [name for name in _alike(group, variant, view) if name not in taken]
        found = [name for name in found if _starts_so(group, name, members, view)]
        if len(found) < group.count:
            raise RefusedError(
                RefusalReason.NO_SCENE_OBJECT,
                f"{variant.scene.scene_id} has {len(found)} of {group.count} {group.label} as the wish describes them",
            )
        members[group.label] = tuple(found[: group.count])
        if not group.furniture:
            taken.update(members[group.label])
    return members


def _alike(group: WishedObjects, variant: Variant, view: SceneView) -> Sequence[str]:
    if group.kind == FLOOR:
        floor = view.floor_of(group.room)
        return (floor,) if floor else ()
    rooms = (group.room,) if group.room else variant.rooms
    return [
        name for room in rooms for name in view.in_room.get(room, ()) if view.category(name) == group.kind
    ]


def _starts_so(group: WishedObjects, name: str, members: Members, view: SceneView) -> bool:
    """True if the object is where the group starts, and in its states."""
    if group.relation is not None:
        hosts = members.get(group.host, ())
        if not any(view.rests(name, group.relation, host) for host in hosts):
            return False
    if set(group.states) - _READ:
        return False
    is_open = view.is_openable(name) and view.is_open(name)
    return (State.OPEN in group.states) is is_open and (State.TOGGLED_ON in group.states) is (
        view.is_toggleable(name) and view.is_on(name)
    )


def _clauses(condition: Condition, members: Members) -> list[IntentClause]:
    """Return what the condition demands: of each object, or of any of them."""
    things, places = members[condition.things], members.get(condition.place, ())
    each = [things] if condition.quantity is Quantity.ANY else [(thing,) for thing in things]
    holds = not is_negative(condition)
    return [IntentClause(condition.predicate.value, names, tuple(places), holds) for names in each]
