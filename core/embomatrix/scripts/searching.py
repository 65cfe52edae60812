"""Searching script: it knows what to do and with which objects, but not where those are that it has not seen.

It looks for missing objects first: in rooms, in closed containers and beside furniture, the most promising place per call
first. Counts of training tasks say where things usually are. Then it carries out the plan from what it knows.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from embomatrix.skills.prompt import plain_words
from embomatrix.skills.syntax import Skill, SkillCall

if TYPE_CHECKING:
    from embomatrix.skills.prompt import PromptRow, Situation
    from embomatrix.skills.syntax import Plan
    from embomatrix.skills.trace import Step

UNKNOWN: Final = 0.5
"""Count of a place in which a category was never seen."""
NAMED: Final = 4.0
"""Factor for a place that the instruction names."""
NOWHERE: Final = ""
"""Host of an object on the floor."""
_ASIDE: Final = 0.1
"""Share of the chance that an object in a room is hidden from its middle, and seen from beside a piece of furniture."""
_UNDONE: Final[Mapping[Skill, str]] = {
    Skill.OPEN: "open",
    Skill.CLOSE: "closed",
    Skill.TOGGLE_ON: "on",
    Skill.TOGGLE_OFF: "off",
}
"""States in which a call has nothing left to do."""


class PlacePriors:
    """Frequency of a category's objects in kinds of rooms, and on or in categories of furniture."""

    def __init__(self, situations: Iterable[Situation] = ()) -> None:
        """Count the rows of these situations."""
        self._rooms: dict[str, Counter[str]] = {}
        self._hosts: dict[str, Counter[str]] = {}
        for situation in situations:
            by_name = {row.name: row for row in situation.rows}
            for row in situation.rows:
                self._rooms.setdefault(row.category, Counter())[room_kind(row.room)] += 1
                host = by_name[row.host].category if row.host in by_name else NOWHERE
                self._hosts.setdefault(row.category, Counter())[host] += 1

    def room(self, category: str, kind: str) -> float:
        """Share of the category's objects that are in this kind of room."""
        return _share(self._rooms.get(category, Counter()), kind)

    def host(self, category: str, host: str) -> float:
        """Share of the category's objects that are on or in this category of furniture."""
        return _share(self._hosts.get(category, Counter()), host)


def _share(counts: Counter[str], kind: str) -> float:
    return max(float(counts[kind]), UNKNOWN) / (counts.total() + 1.0)


def room_kind(room: str) -> str:
    """Kind of a room, ``kitchen`` of ``kitchen_0``."""
    return room.rpartition("_")[0] or room


@dataclass(frozen=True, slots=True)
class _Place:
    """Place to look at: a room, a closed container, or a piece of furniture to come near."""

    key: str
    calls: tuple[SkillCall, ...]
    chance: float

    @property
    def worth(self) -> float:
        return self.chance / len(self.calls)


class SearchingScript:
    """One episode of the script. ``categories`` has those of all rows in the ``plan``."""

    def __init__(self, plan: Plan, categories: Mapping[int, str], priors: PlacePriors) -> None:
        self._plan = deque(plan)
        self._categories = categories
        self._priors = priors
        self._queue: deque[SkillCall] = deque()
        """Calls that lead to the place to look at."""
        self._looked: set[str] = set()
        self._opened: int | None = None
        """Row of the container that was opened to look into it."""
        self._missing_before = len(categories)
        self._again = False

    @classmethod
    def of(cls, plan: Plan, situation: Situation, priors: PlacePriors) -> SearchingScript:
        """Script for a plan of a task with this whole situation."""
        used = {index for call in plan for index in (call.object_index, call.source_index)}
        return cls(plan, {row.index: row.category for row in situation.rows if row.index in used}, priors)

    def take_over(self, known: Situation, steps: Iterable[Step]) -> None:
        """Take in what was done before the script: it looks at no place a second time, unless that is closed."""
        rows = {row.index: row for row in known.rows}
        for step in steps:
            row = rows.get(step.call.object_index) if step.call.object_index is not None else None
            if step.ok and row is not None and "closed" not in row.states:
                self._looked.add(row.name)
            elif step.ok and step.call.room_name is not None:
                self._looked.add(step.call.room_name)

    def next_call(self, known: Situation, last: Step | None) -> SkillCall | None:
        """Return the next call; None if the plan is done, or there is nowhere left to look.

        ``known`` is what the policy knows now, ``last`` the outcome of the last call.
        """
        self._looked.add(known.robot_room)
        rows = {row.index: row for row in known.rows}
        missing = {index for index in self._categories if index not in rows}
        if last is not None and not last.ok:
            self._queue.clear()
        if self._queue:
            return self._queue.popleft()
        closing = self._close(rows, missing)
        if closing is not None:
            return closing
        if not missing or (known.held and self._knows_until_placed(rows)):
            return self._carry_on(rows, last)
        places = sorted(self._places(known, missing), key=lambda place: (-place.worth, place.key))
        if not places:
            return None
        self._looked.add(places[0].key)
        self._missing_before = len(missing)
        self._queue.extend(places[0].calls)
        call = self._queue.popleft()
        if places[0].calls[-1].skill is Skill.OPEN:
            self._opened = places[0].calls[-1].object_index
        return call

    def _close(self, rows: Mapping[int, PromptRow], missing: set[int]) -> SkillCall | None:
        """Close a container that was opened in vain."""
        opened, self._opened = self._opened, None
        if opened is None or "open" not in rows[opened].states or len(missing) < self._missing_before:
            return None
        return SkillCall(Skill.CLOSE, object_index=opened)

    def _knows_until_placed(self, rows: Mapping[int, PromptRow]) -> bool:
        """Return whether all rows are known that the plan names before it has placed what is in the hand.

        Nothing opens with a full hand, so what is in it is placed before the search.
        """
        for call in self._plan:
            if not {call.object_index, call.source_index} - {None} <= rows.keys():
                return False
            if call.skill is Skill.PLACE:
                return True
        return False

    def _carry_on(self, rows: Mapping[int, PromptRow], last: Step | None) -> SkillCall | None:
        """Return the plan's next call. A call that failed is made once more, after a move to its object."""
        if last is not None and not last.ok and not self._again and last.call.object_index is not None:
            self._again = True
            self._plan.appendleft(last.call)
            return SkillCall(Skill.MOVE, object_index=last.call.object_index)
        self._again = False
        while self._plan:
            call = self._plan.popleft()
            row = rows.get(call.object_index) if call.object_index is not None else None
            if row is None or _UNDONE.get(call.skill) not in row.states:
                return call
        return None

    def _places(self, known: Situation, missing: set[int]) -> Iterator[_Place]:
        """Yield the places that were not looked at yet."""
        wanted = [self._categories[index] for index in sorted(missing)]
        said = f" {plain_words(known.instruction)} "
        for room in known.home:
            if room not in self._looked:
                chance = sum(self._priors.room(category, room_kind(room)) for category in wanted)
                chance *= NAMED if f" {room_kind(room).replace('_', ' ')} " in said else 1.0
                yield _Place(room, (SkillCall(Skill.GO_TO_ROOM, room_name=room),), chance)
        for row in known.rows:
            if row.name in self._looked or not row.fixed:
                continue
            move = SkillCall(Skill.MOVE, object_index=row.index)
            named = NAMED if f" {row.category.replace('_', ' ')} " in said else 1.0
            in_room = named * sum(self._priors.room(category, room_kind(row.room)) for category in wanted)
            if "closed" in row.states:
                if known.held:
                    continue
                chance = sum(
                    self._priors.room(category, room_kind(row.room))
                    * self._priors.host(category, row.category)
                    for category in wanted
                )
                open_ = SkillCall(Skill.OPEN, object_index=row.index)
                yield _Place(row.name, (move, open_), named * chance)
            else:
                yield _Place(row.name, (move,), _ASIDE * in_room)
