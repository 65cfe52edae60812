"""Days whose people, dialogues and wishes a language model writes. The scene is laid out for the wishes."""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from embomatrix.factory.admission import RefusalReason, TaskRefusal
from embomatrix.factory.days.drafts import Members, PlannedTask, draft_of, task_of
from embomatrix.factory.days.laying import SEEDS, lay_out
from embomatrix.factory.days.planning import PlannedDay, day_name
from embomatrix.factory.language.nouns import noun_of
from embomatrix.factory.layout.request import LayoutAgents
from embomatrix.factory.pipeline.variants import VariantOrder
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.day import wanted_kinds
from embomatrix.factory.social.model.writer import ModelWriter
from embomatrix.factory.social.scene_kinds import kinds_of
from embomatrix.factory.social.wish import FLOOR, Wish, WishedObjects, WishPredicate
from embomatrix.factory.social.written import WrittenRequest
from embomatrix.world.catalog import Catalog
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task

REQUESTS_OF_DAY: Final = 6
"""Number of requests that a day asks the model for."""


TOOLS: Final = (
    (frozenset({WishPredicate.SLICED}), "slicer", "spare_knife", "carving_knife"),
    (frozenset({WishPredicate.DUSTY, WishPredicate.STAINED}), "particleRemover", "spare_cloth", "rag"),
)
"""Tools by the predicates that need one: the ability, the label and the category."""


class ModelDays:
    """Planner of days on a language model. Earlier instructions of the same home are in the model's view."""

    def __init__(self, writer: ModelWriter, agents: LayoutAgents | None = None) -> None:
        self._writer = writer
        self._agents = agents

    def plan(self, order: VariantOrder, base: Scene, seed: int) -> PlannedDay | TaskRefusal:
        """Return a day of requests with the refusals on the way. Raise LlmError after several answers without use."""
        key = (seed, zlib.crc32(order.split.encode()), zlib.crc32(order.base.encode()), order.number)
        rng = np.random.default_rng(np.random.SeedSequence(key))
        written = self._writer.write(
            kinds_of(SceneView(base)), REQUESTS_OF_DAY, int(rng.integers(SEEDS)), order.told
        )
        refusals = [each for each in written if isinstance(each, TaskRefusal)]
        requests = _of_different_things([each for each in written if isinstance(each, WrittenRequest)])
        if not requests:
            reason = TaskRefusal(
                RefusalReason.UNUSABLE_ANSWER, "the model wrote no request that could be used"
            )
            return refusals[-1] if refusals else reason
        wishes = [with_tools(each.wish) for each in requests]
        laid = lay_out(day_name(order), wishes, base, rng, self._agents, exact=True)
        if isinstance(laid, TaskRefusal):
            return laid
        view = SceneView(laid.scene)
        tasks: list[PlannedTask] = []
        for number, (at, members) in enumerate(zip(laid.kept, laid.members, strict=True)):
            found = planned_task(f"{day_name(order)}-{number:02d}", view, requests[at], members)
            if isinstance(found, TaskRefusal):
                refusals.append(found)
            else:
                tasks.append(found)
        return PlannedDay(laid.scene, tuple(tasks), tuple(refusals))


def with_tools(wish: Wish) -> Wish:
    """Return the wish with the knife or the cloth that its conditions need, if it declares none. Nobody mentions these."""
    catalog = Catalog.load()
    kinds = [group.kind for group in wish.objects if group.kind != FLOOR]
    abilities = {ability for kind in kinds for ability in catalog.abilities_of(catalog.synset_of(kind))}
    added = []
    for predicates, ability, label, tool in TOOLS:
        about = next((each.things for each in wish.conditions if each.predicate in predicates), None)
        if about is not None and ability not in abilities and label not in wish.groups:
            added.append(WishedObjects(label=label, kind=tool, room=wish.room_of(about)))
    return wish.model_copy(update={"objects": (*wish.objects, *added)}) if added else wish


def _of_different_things(requests: Sequence[WrittenRequest]) -> list[WrittenRequest]:
    """Return the requests without those that ask for the same kinds of things as an earlier one of the day."""
    kept: list[WrittenRequest] = []
    asked: set[tuple[str, str]] = set()
    for request in requests:
        things = wanted_kinds(request.wish)
        if not things & asked:
            kept.append(request)
            asked |= things
    return kept


def planned_task(
    task_id: str, view: SceneView, request: WrittenRequest, members: Members
) -> PlannedTask | TaskRefusal:
    """Return the task of a request in the scene that is laid out; a refusal if its words also fit other objects."""
    conditions = request.wish.conditions
    about = tuple(dict.fromkeys(name for names in members.values() for name in names))
    wanted = {label: members[label] for label in request.wish.wanted}
    task = replace(task_of(task_id, view, conditions, wanted, about), instruction=request.instruction)
    for names in wanted.values():
        other = _also_meant(view, task, names)
        if other:
            return TaskRefusal(
                RefusalReason.UNFAITHFUL,
                f"the words for {'/'.join(names)} also fit {other}: say which one is meant",
            )
    return PlannedTask(draft_of(view, task, wanted, about, request.transcript()), request.conversation)


def _also_meant(view: SceneView, task: Task, names: Sequence[str]) -> str:
    """Return a row of the same category whose place the instruction does not exclude; "" if there is none."""
    said = task.instruction.lower()
    for other in task.table:
        if other in names or view.category(other) != view.category(names[0]):
            continue
        told = {*_place_words(view, names[0])} - {*_place_words(view, other)}
        if not any(re.search(rf"\b{re.escape(word)}\b", said) for word in told):
            return other
    return ""


def _place_words(view: SceneView, name: str) -> tuple[str, ...]:
    """Return the noun of the support of an object, and its room by type and by name."""
    host, room = view.item(name).host, view.room(name)
    rooms = (room.rpartition("_")[0].replace("_", " "), room.replace("_", " "))
    return (*rooms, *((noun_of(view.category(host)).one,) if host else ()))
