"""Prompts: the description of a task for a policy, and the naming of objects in its plans.

Three codecs share one scene description, a tree of rooms, furniture and contents:

* ``names``: for word-level policies. Plans name objects; ``with_indices`` maps the names to rows of the object table before
  the plan is parsed.
* ``lines``: for language models. One call a line, objects by ``object_index``; the prompt prints the index after each name.
* ``json``: for language models. The same calls as a JSON list.

A prompt covers the rows of the task's object table and never contains the goal formula.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from embomatrix.skills.describe import words_of
from embomatrix.skills.syntax import PROFILES, SIGNATURES, Arg, PlaceRelation, Plan, Skill
from embomatrix.world.state import OPEN_FRACTION, Relation, State
from embomatrix.world.substances import MEANINGS, facts_of, in_words
from embomatrix.world.task import Profile, Task

if TYPE_CHECKING:
    from embomatrix.world.scene import Scene, SceneObject


class Codec(StrEnum):
    """Form of prompts and plans."""

    NAMES = "names"
    LINES = "lines"
    JSON = "json"


PREPOSITIONS: Final[Mapping[Relation, str]] = {
    Relation.ONTOP: "on",
    Relation.INSIDE: "in",
    Relation.UNDER: "under",
}
"""Preposition before the contents of a row. Objects are listed with their host only for these relations."""
ABSENT: Final = "absent"
"""State of a row that is not in the world yet: a piece of an object that can be sliced."""


@dataclass(frozen=True, slots=True)
class PromptRow:
    """One row of the object table in a prompt. ``host`` is the name of another row, or empty."""

    index: int
    name: str
    category: str
    room: str
    host: str = ""
    relation: Relation | None = None
    states: tuple[str, ...] = ()
    fixed: bool = False


@dataclass(frozen=True, slots=True)
class Situation:
    """Everything that a policy may know about a task. ``rows`` are in prompt order.

    ``table_size`` is the number of rows in the whole object table: the first index without an object. ``profile`` selects the
    skills that the prompt offers.
    """

    rooms: tuple[str, ...]
    robot_room: str
    rows: tuple[PromptRow, ...]
    instruction: str
    table_size: int
    profile: Profile = Profile.PAPER
    home: tuple[str, ...] = ()
    """All rooms of the scene."""
    held: tuple[str, ...] = ()
    """Name of the object in the robot's hand, then those of its contents."""
    full_names: bool = False
    """Rows have their full names, because further rows may come to be known."""


@dataclass(frozen=True, slots=True)
class Prompt:
    """System text, equal for all tasks of a codec and profile, and the text of one task."""

    system: str
    user: str


def situation_of(scene: Scene, task: Task) -> Situation:
    """Return the rows of a task's object table with their initial host, relation and visible states."""
    listed = set(task.table)
    rows = tuple(_row(index, scene.by_name[name], scene, listed) for index, name in enumerate(task.table))
    rooms = tuple(dict.fromkeys([*(row.room for row in rows if row.room), scene.robot.room]))
    home = tuple(room.name for room in scene.rooms)
    return Situation(rooms, scene.robot.room, rows, task.instruction, len(task.table), task.profile, home)


def _row(index: int, item: SceneObject, scene: Scene, listed: set[str]) -> PromptRow:
    asset = scene.asset_of(item.name)
    hosted = item.host in listed and item.relation in PREPOSITIONS
    return PromptRow(
        index=index,
        name=item.name,
        category=asset.category,
        room=item.room,
        host=item.host if hosted else "",
        relation=item.relation if hosted else None,
        states=_visible(item, openable=bool(asset.joints), toggleable=asset.can("toggleable")),
        fixed=item.fixed,
    )


def _visible(item: SceneObject, *, openable: bool, toggleable: bool) -> tuple[str, ...]:
    """Return words for visible states: doors and switches in both positions, other states only when they hold."""
    words: list[str] = []
    if openable:
        is_open = State.OPEN in item.states or any(joint > OPEN_FRACTION for joint in item.joints)
        words.append("open" if is_open else "closed")
    if toggleable:
        words.append("on" if State.TOGGLED_ON in item.states else "off")
    if item.absent:
        words.append(ABSENT)
    plain = item.states - {State.OPEN, State.TOGGLED_ON} - MEANINGS.keys()
    substances = (in_words(fact) for fact in sorted(facts_of(item.states, item.substances)))
    return (
        *words,
        *sorted([*(state.value for state in plain), *(words.replace(" ", "_") for words in substances)]),
    )


def limited(situation: Situation, rows: int) -> Situation:
    """Keep at most ``rows`` rows: first those that the instruction names, then their hosts, then the rest in order.

    The choice depends on the instruction and never on the goal, because a policy knows no more than that.
    """
    if len(situation.rows) <= rows:
        return situation
    return subset(situation, {row.index for row in ranked_rows(situation)[:rows]})


def ranked_rows(situation: Situation) -> tuple[PromptRow, ...]:
    """Return the rows in the order in which ``limited`` keeps them."""
    text = f" {plain_words(situation.instruction)} "
    by_name = {row.name: row for row in situation.rows}
    named = [row for row in situation.rows if f" {plain_words(row.category)} " in text]
    hosts = [by_name[row.host] for row in named if row.host in by_name]
    return tuple(dict.fromkeys([*named, *hosts, *situation.rows]))


def subset(situation: Situation, kept: Iterable[int]) -> Situation:
    """Keep only these rows. A row whose host is left out is listed in its room."""
    wanted = set(kept)
    names = {row.name for row in situation.rows if row.index in wanted}
    rows = tuple(
        row if not row.host or row.host in names else replace(row, host="", relation=None)
        for row in situation.rows
        if row.index in wanted
    )
    return replace(situation, rows=rows)


def plain_words(text: str) -> str:
    """Words of a text in lower case with single spaces, without punctuation."""
    return " ".join(re.findall(r"[a-z0-9]+", text.lower()))


def labels(situation: Situation) -> dict[int, str]:
    """Map row indices to shortest unique names: the category if only one row has it, else the name."""
    if situation.full_names:
        return {row.index: row.name for row in situation.rows}
    counts: dict[str, int] = {}
    for row in situation.rows:
        counts[row.category] = counts.get(row.category, 0) + 1
    return {row.index: row.category if counts[row.category] == 1 else row.name for row in situation.rows}


def prompt_for(situation: Situation, codec: Codec) -> Prompt:
    """Return the prompt that a policy completes with a plan."""
    if codec is Codec.NAMES:
        return Prompt("", _names_text(situation))
    return Prompt(_SYSTEM[codec, situation.profile], _indexed_text(situation))


def _tree(situation: Situation) -> dict[str, list[tuple[PromptRow, list[PromptRow]]]]:
    """Map rooms to their rows with contents. A hosted row gets its own entry only if it hosts other rows.

    What the robot holds is left out.
    """
    placed = [row for row in situation.rows if row.name not in situation.held]
    contents: dict[str, list[PromptRow]] = {}
    for row in placed:
        if row.host:
            contents.setdefault(row.host, []).append(row)
    tree: dict[str, list[tuple[PromptRow, list[PromptRow]]]] = {}
    for row in placed:
        inside = contents.get(row.name, [])
        if inside or not row.host:
            tree.setdefault(row.room, []).append((row, inside))
    return tree


def _by_relation(contents: list[PromptRow]) -> list[tuple[str, list[PromptRow]]]:
    groups: dict[str, list[PromptRow]] = {}
    for row in contents:
        if row.relation is not None:
            groups.setdefault(PREPOSITIONS[row.relation], []).append(row)
    return list(groups.items())


def _names_text(situation: Situation) -> str:
    label = labels(situation)

    def words(row: PromptRow) -> str:
        return " ".join([label[row.index], *row.states])

    lines: list[str] = []
    hand = ["holds", *map(words, held_rows(situation))] if situation.held else []
    for room, entries in _tree(situation).items():
        lines.append(f"room {room}")
        for row, contents in entries:
            groups = [f"{word} {' '.join(map(words, rows))}" for word, rows in _by_relation(contents)]
            lines.append(" ".join([words(row), *groups]))
    robot = " ".join(["robot", situation.robot_room, *hand])
    return "\n".join([*lines, robot, f"task {situation.instruction}"])


def held_rows(situation: Situation) -> list[PromptRow]:
    """Rows of the object in the robot's hand and its contents."""
    by_name = {row.name: row for row in situation.rows}
    return [by_name[name] for name in situation.held if name in by_name]


def indexed(row: PromptRow) -> str:
    """Name of a row for language models: its category, and its index in the table."""
    return f"{row.category.replace('_', ' ')} {row.index}"


def _indexed_text(situation: Situation) -> str:
    def words(row: PromptRow) -> str:
        return " ".join([indexed(row), *row.states])

    lines = ["Scene:"]
    for room, entries in _tree(situation).items():
        lines.append(f"[{room}]")
        for row, contents in entries:
            groups = [f"{word}: {', '.join(map(words, rows))}" for word, rows in _by_relation(contents)]
            lines.append(" ".join([words(row), *groups]))
    lines.append(robot_in_words(situation.robot_room, [*map(words, held_rows(situation))]))
    lines.append(f"Task: {situation.instruction}")
    return "\n".join(lines)


def robot_in_words(room: str, held: Sequence[str]) -> str:
    """Line about the robot for language models: its room, and the named object in its hand with its contents."""
    hand = f"holding {held[0]}" if held else "hand empty"
    inside = f" with {', '.join(held[1:])} in it" if held[1:] else ""
    return f"Robot: {room or 'unknown room'}, {hand}{inside}"


_PLACEHOLDERS: Final[Mapping[Arg, str]] = {
    Arg.OBJECT: "object",
    Arg.SOURCE: "source",
    Arg.RELATION: "|".join(PlaceRelation),
    Arg.YAW: "radians",
    Arg.DISTANCE: "metres",
    Arg.ROOM: "room",
}

EXAMPLES: Final[Mapping[Codec, str]] = {
    Codec.NAMES: "move fridge\nopen fridge\nmove apple\npick_up apple\nmove fridge\nplace fridge inside\nclose fridge",
    Codec.LINES: "move 2\nopen 2\nmove 4\npick_up 4\nmove 2\nplace 2 inside\nclose 2",
    Codec.JSON: '[{"action": "move", "object_index": 2}, {"action": "open", "object_index": 2}, '
    '{"action": "move", "object_index": 4}, {"action": "pick_up", "object_index": 4}, '
    '{"action": "move", "object_index": 2}, {"action": "place", "object_index": 2, "relation": "inside"}, '
    '{"action": "close", "object_index": 2}]',
}
"""Example plan in each codec: put the apple (row 4) into the fridge (row 2)."""


def skill_line(skill: Skill) -> str:
    """Skill with its arguments as a call on a line: ``turn radians``."""
    return " ".join([skill.value, *(_PLACEHOLDERS[argument] for argument in SIGNATURES[skill])])


def skill_lines(profile: Profile) -> str:
    """Skills of a profile with their arguments, as calls on lines."""
    return " | ".join(map(skill_line, PROFILES[profile]))


def skill_objects(profile: Profile) -> str:
    """Skills of a profile with their arguments, as JSON objects."""
    return "\n".join(
        "{"
        + ", ".join(
            [f'"action": "{skill.value}"', *(f'"{a.value}": <{_PLACEHOLDERS[a]}>' for a in SIGNATURES[skill])]
        )
        + "}"
        for skill in PROFILES[profile]
    )


RULES: Final = (
    "The robot has one arm and holds one object; doors and switches need the empty hand. Move to an object before you "
    "use it, open closed containers before you pick up what goes inside. "
    "Objects are called by the number that follows their name."
)
_STOPS: Final = " The plan stops at the first step that fails."
_HOUSEHOLD_RULES: Final = (
    " Slice, wipe and brush with the tool in the hand, which is the source; a sink or a machine that runs washes what lies "
    "in it. A cloth takes dust off dry, and stains when it is soaked. What is absent comes when another object is sliced."
)
ADDED_RULES: Final[Mapping[Profile, str]] = {Profile.PAPER: "", Profile.HOUSEHOLD: _HOUSEHOLD_RULES}


def _system(codec: Codec, profile: Profile) -> str:
    rules = f"{RULES}{_STOPS}{ADDED_RULES[profile]}\nExample, put apple 4 into fridge 2:\n{EXAMPLES[codec]}"
    if codec is Codec.LINES:
        return (
            "You control a home robot. Answer only with the plan, one action a line.\n"
            f"Actions: {skill_lines(profile)}\n{rules}"
        )
    return (
        "You control a home robot. Answer only with the plan, a JSON list of actions.\n"
        f"Actions:\n{skill_objects(profile)}\n{rules}"
    )


_SYSTEM: Final[Mapping[tuple[Codec, Profile], str]] = {
    (codec, profile): _system(codec, profile) for codec in (Codec.LINES, Codec.JSON) for profile in Profile
}


def plan_in_names(plan: Plan, situation: Situation) -> str:
    """Write a plan in the ``names`` codec, one call a line. Rows that the situation lacks are named ``row_<index>``."""
    label = labels(situation)
    return "\n".join(words_of(call, lambda index: label.get(index, f"row_{index}")) for call in plan)


_SKILLS: Final = frozenset(Skill)


def with_indices(text: str, situation: Situation) -> str:
    """Replace the names in a plan of the ``names`` codec by row indices.

    An unknown name becomes the first index after the table: the plan parses, and that step fails as unknown object. Text that
    is not a plan stays unparsable.
    """
    rows = {row.name: row.index for row in situation.rows}
    rows |= {label: index for index, label in labels(situation).items()}
    return "\n".join(_line_with_indices(line, rows, situation.table_size) for line in text.splitlines())


def _line_with_indices(line: str, rows: Mapping[str, int], unknown: int) -> str:
    words = line.split()
    if not words or words[0] not in _SKILLS:
        return line
    signature = SIGNATURES[Skill(words[0])]
    changed = [
        str(rows.get(word, unknown)) if argument in (Arg.OBJECT, Arg.SOURCE) else word
        for argument, word in zip(signature, words[1:], strict=False)
    ]
    return " ".join([words[0], *changed, *words[1 + len(signature) :]])
