"""Drafts of tasks from the needs of a day: goal, object table and instruction in a scene that is laid out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from embomatrix.factory.days.laying import SOURCE
from embomatrix.factory.language.clauses import PhraseBook
from embomatrix.factory.language.references import Describer
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.day import NeedOfDay
from embomatrix.factory.social.dialogue import converse, transcript_of
from embomatrix.factory.social.telling import Asked, Teller, UndescribableError
from embomatrix.factory.social.values import Cast, Conversation
from embomatrix.factory.social.wish import PAIRS, Condition, Quantity, WishPredicate, goal_of
from embomatrix.factory.task_import.reach import profile_for
from embomatrix.factory.task_import.task_fields import signature_of, sources_for, taps_for
from embomatrix.factory.writer.categories import category_of
from embomatrix.factory.writer.tasks import Draft, object_table
from embomatrix.factory.writer.words import FreshVoice
from embomatrix.skills.prompt import situation_of
from embomatrix.world.evaluate import render, types_of
from embomatrix.world.goal import Formula
from embomatrix.world.intent import goal_clauses
from embomatrix.world.scene import Scene
from embomatrix.world.task import Task

Members = Mapping[str, tuple[str, ...]]
NEEDS_OF_TASK: Final = (1, 1, 1, 2, 2, 3)
"""Numbers of needs of one event that a task joins; each entry is equally likely."""
NEEDS_OF_LONG_TASK: Final = (3, 4, 5, 6)
"""Numbers of needs of one person that a long task joins, which may belong to several events."""
LONG_SHARE: Final = 0.4
"""Share of people, among those with enough needs, who ask for a long task."""
MAX_HOURS_APART: Final = 4
"""Maximum time between the events of a long task."""
MAX_ROWS: Final = 40
"""Maximum number of rows of a table, so that a person can read the prompt."""


@dataclass(frozen=True, slots=True)
class DayScene:
    """Scene of a day with its needs, and the scene names of each need's objects by label."""

    scene: Scene
    needs: tuple[NeedOfDay, ...]
    members: tuple[Members, ...]


@dataclass(frozen=True, slots=True)
class PlannedTask:
    """Draft with the conversation behind it."""

    draft: Draft
    conversation: Conversation


@dataclass(frozen=True, slots=True)
class Combination:
    """Needs of one person that one task joins, by the hour of their events, with the objects of each need by label."""

    needs: tuple[NeedOfDay, ...]
    members: tuple[Members, ...]


def combinations_of(day: DayScene, rng: np.random.Generator) -> list[Combination]:
    """Return the needs of the day in groups: a long one of some of the people, the others by event. No need is in two."""
    found: list[Combination] = []
    by_event: dict[str, list[int]] = {}
    joined = _long_groups(day, rng)
    for number, need in enumerate(day.needs):
        if not any(number in group for group in joined):
            by_event.setdefault(need.event.name, []).append(number)
    for numbers in by_event.values():
        left = [numbers[int(at)] for at in rng.permutation(len(numbers))]
        while left:
            size = min(len(left), NEEDS_OF_TASK[int(rng.integers(len(NEEDS_OF_TASK)))])
            chosen, left = left[:size], left[size:]
            found.append(_combination(day, chosen))
    return [*found, *(_combination(day, group) for group in joined)]


def _long_groups(day: DayScene, rng: np.random.Generator) -> list[list[int]]:
    """Return the positions of the needs of each long task, by the hour of their events."""
    by_person: dict[str, list[int]] = {}
    for number, need in enumerate(day.needs):
        by_person.setdefault(need.person.name, []).append(number)
    found = []
    for numbers in by_person.values():
        order = [numbers[int(at)] for at in rng.permutation(len(numbers))]
        size = NEEDS_OF_LONG_TASK[int(rng.integers(len(NEEDS_OF_LONG_TASK)))]
        hour = day.needs[order[0]].hour
        near = [at for at in order if abs(day.needs[at].hour - hour) <= MAX_HOURS_APART / 2][:size]
        if rng.random() < LONG_SHARE and len(near) >= NEEDS_OF_LONG_TASK[0]:
            found.append(sorted(near, key=lambda at: (day.needs[at].hour, day.needs[at].event.name)))
    return found


def _combination(day: DayScene, chosen: Sequence[int]) -> Combination:
    return Combination(tuple(day.needs[at] for at in chosen), tuple(day.members[at] for at in chosen))


class DraftWriter:
    """Writer of drafts in the scene of a day. ``voice`` prefers the phrases that were used least."""

    def __init__(self, day: DayScene, cast: Cast, split: str, seed: int, voice: FreshVoice) -> None:
        self._cast = cast
        self._view = SceneView(day.scene)
        self._split = split
        self._seed = seed
        self._voice = voice
        self._book = PhraseBook(split, seed)

    def trial(self, need: NeedOfDay, members: Members) -> Task:
        """Return a need as a task of its own, without words, to test whether it can be met at all."""
        conditions, own, about = self._joined(Combination((need,), (members,)))
        return task_of(f"trial-{need.need.name}", self._view, conditions, own, about)

    def draft(self, task_id: str, combination: Combination) -> PlannedTask | None:
        """Return the draft of a task; None if its objects can't be told apart.

        Words that fit several equal pieces of furniture mean any of them, and so does the goal.
        """
        conditions, members, about = self._joined(combination)
        if not _pairs_have_types(conditions, _types(self._view, conditions, members)):
            return None
        task = task_of(task_id, self._view, conditions, members, about)
        while _is_whole(task, members) and (unclear := self._unclear(task, members)) is not None:
            alike = self._alike(members[unclear])
            about_doors = any(
                each.things == unclear and each.predicate is WishPredicate.OPEN for each in conditions
            )
            if len(alike) == len(members[unclear]) or about_doors:  # nobody wants just any cabinet closed
                return None
            names = members[unclear]
            members = {label: alike if each == names else each for label, each in members.items()}
            conditions = [_of_any(each) if members[each.things] == alike else each for each in conditions]
            about = tuple(dict.fromkeys((*about, *alike)))
            task = task_of(task_id, self._view, conditions, members, about)
        if len(task.table) > MAX_ROWS or not _is_whole(task, members):
            return None
        told = self._told(task, combination, conditions, members)
        if told is None:
            return None
        instruction, talk = told
        transcript = transcript_of(self._cast, combination.needs[0], talk, instruction, task.goal_bddl)
        told_task = replace(task, instruction=instruction)
        return PlannedTask(draft_of(self._view, told_task, members, about, transcript), talk)

    def _joined(
        self, combination: Combination
    ) -> tuple[list[Condition], dict[str, tuple[str, ...]], tuple[str, ...]]:
        """Return the conditions of all needs with labels that are unique across them, and all objects."""
        conditions: list[Condition] = []
        members: dict[str, tuple[str, ...]] = {}
        for number, (need, names) in enumerate(zip(combination.needs, combination.members, strict=True)):
            for condition in need.wish.conditions:
                members |= {f"{label}_{number}": names[label] for label in condition.labels}
                conditions.append(
                    _renamed(condition, {label: f"{label}_{number}" for label in condition.labels})
                )
        about = dict.fromkeys(
            name for need in combination.members for names in need.values() for name in names
        )
        return conditions, members, tuple(about)

    def _unclear(self, task: Task, members: Members) -> str | None:
        """Return the label of objects that no description distinguishes from other rows."""
        describer = self._describer(task, members)
        return next((label for label, names in members.items() if describer.describe(names) is None), None)

    def _alike(self, names: tuple[str, ...]) -> tuple[str, ...]:
        """Return all furniture of the same category in the same room; the same names for other objects."""
        if len(names) > 1 or not self._view.item(names[0]).fixed:
            return names
        return self._view.alike(names[0])

    def _describer(self, task: Task, members: Members) -> Describer:
        rows = {row.name: row for row in situation_of(self._view.scene, task).rows}
        loose = (name for names in members.values() for name in names if not rows[name].fixed)
        return Describer(
            rows=rows,
            rooms=[room.name for room in self._view.scene.rooms],
            voice=self._voice,
            split=self._split,
            seed=self._seed,
            taken=frozenset(loose),
        )

    def _told(
        self, task: Task, combination: Combination, conditions: Sequence[Condition], members: Members
    ) -> tuple[str, Conversation] | None:
        """Return the instruction and the conversation behind it; None if the objects can't be told apart."""
        teller = Teller(self._describer(task, members), self._book, self._voice)
        asked = []
        for number, (need, names) in enumerate(zip(combination.needs, combination.members, strict=True)):
            suffix = f"_{number}"
            changed = {
                label.removesuffix(suffix): each for label, each in members.items() if label.endswith(suffix)
            }
            own = [_without(each, suffix) for each in conditions if each.things.endswith(suffix)]
            asked.append(Asked(need, {**names, **changed}, own))
        try:
            instruction = teller.instruction(asked)
            return instruction, converse(
                asked, teller, self._voice, self._view.room(next(iter(task.goal_objects)))
            )
        except UndescribableError:
            return None


def _pairs_have_types(conditions: Sequence[Condition], types: Mapping[str, str]) -> bool:
    """True if each condition on pairs ranges over types of its own. Other groups of one kind can be written out."""
    return all(
        label in types for each in conditions if each.quantity in PAIRS for label in (each.things, each.place)
    )


def _is_whole(task: Task, members: Members) -> bool:
    """True if the table holds all objects of the conditions; long tables are cut."""
    rows = set(task.table)
    return all(name in rows for names in members.values() for name in names)


def task_of(
    task_id: str, view: SceneView, conditions: Sequence[Condition], members: Members, about: Sequence[str]
) -> Task:
    """Return the task of these conditions, without its instruction. ``about`` are all objects that its wishes name."""
    types = _types(view, conditions, members)
    goal = goal_of(conditions, members, types)
    used = {types[label]: members[label] for label in types if types[label] in types_of(goal)}
    needed = _needed(view, goal, used, about)
    rng = np.random.default_rng(list(task_id.encode()))
    return Task(
        task_id=task_id,
        scene_id=view.scene.scene_id,
        instruction="",
        category=category_of(goal),
        goal=goal,
        goal_bddl=render(goal),
        table=object_table(view, needed, rng, elsewhere=True),
        types=used,
        source=SOURCE,
        profile=profile_for(goal),
    )


def draft_of(view: SceneView, task: Task, members: Members, about: Sequence[str], transcript: str) -> Draft:
    """Return the draft of a task with its instruction. ``members`` are the objects of its conditions by label."""
    return Draft(
        task=task,
        about=_needed(view, task.goal, task.types, about),
        rooms=tuple(sorted({view.room(name) for names in members.values() for name in names})),
        signature=signature_of(task.goal, view),
        intent=goal_clauses(task.goal, task.types),
        transcript=transcript,
    )


def _needed(view: SceneView, goal: Formula, types: Members, about: Sequence[str]) -> tuple[str, ...]:
    """Return the objects of the wishes, with appliances and taps that the goal needs besides."""
    others = (*sources_for(view, goal, types, about), *taps_for(view, goal, about))
    return tuple(dict.fromkeys((*about, *others)))


def _types(view: SceneView, conditions: Sequence[Condition], members: Members) -> dict[str, str]:
    """Return a type for each group that a quantifier ranges over. Groups whose type is taken are written out."""
    types: dict[str, str] = {}
    for condition in conditions:
        for label in (condition.things, condition.place):
            if not label or (len(members[label]) < 2 and condition.quantity not in PAIRS):
                continue
            synset = view.asset(members[label][0]).synset
            taken = {members[other] for other, known in types.items() if known == synset}
            if not taken or taken == {members[label]}:
                types[label] = synset
    return types


def _of_any(condition: Condition) -> Condition:
    return condition.model_copy(update={"quantity": Quantity.ANY})


def _without(condition: Condition, suffix: str) -> Condition:
    return _renamed(condition, {label: label.removesuffix(suffix) for label in condition.labels})


def _renamed(condition: Condition, labels: Mapping[str, str]) -> Condition:
    """Return the condition with other labels, and its alternative and its premise too."""
    return condition.model_copy(
        update={
            "things": labels[condition.things],
            "place": labels.get(condition.place, ""),
            "otherwise": condition.otherwise and _renamed(condition.otherwise, labels),
            "provided": condition.provided and _renamed(condition.provided, labels),
        }
    )
