"""Texts of episodes, format 3: the prompt at the start, and the observation after each answer.

Three codecs, as for prompts: ``names`` for word-level policies, ``lines`` and ``json`` for language models. Objects have the
names that the prompt gives them; an object that the policy does not know is ``something``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from embomatrix.skills.describe import words_of
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.parse import DONE, PlanError, PlanReason, plan_to_json, plan_to_lines
from embomatrix.skills.prompt import (
    ABSENT,
    ADDED_RULES,
    PREPOSITIONS,
    RULES,
    Codec,
    Prompt,
    PromptRow,
    Situation,
    held_rows,
    indexed,
    labels,
    plan_in_names,
    prompt_for,
    robot_in_words,
    skill_lines,
    skill_objects,
)

if TYPE_CHECKING:
    from embomatrix.skills.describe import ObjectDescription
    from embomatrix.skills.syntax import SkillCall
    from embomatrix.skills.trace import Step
    from embomatrix.world.task import Profile

FORMAT: Final = 3
"""Version of the texts. It changes when any of them does."""
UNKNOWN: Final = "something"
"""Name of an object that the policy does not know."""
DID: Final = "did"
FAILED: Final = "failed"
UNPARSABLE: Final = "unparsable"
OBSERVATION_WORDS: Final = (DID, FAILED, UNPARSABLE, UNKNOWN, "holds", "rooms", *FailureReason)
"""Words of observations in the codec ``names``, besides those of prompts."""
_NAME: Final = re.compile(r"\b[a-z][a-z0-9_]*_\d+\b")
_FIRST: Final = ("open", "closed", "on", "off")
"""States that a prompt names before the others."""

EXAMPLES: Final[Mapping[Codec, tuple[str, str]]] = {
    Codec.LINES: ("open 2", DONE),
    Codec.JSON: ('{"action": "open", "object_index": 2}', f'{{"action": "{DONE}"}}'),
}
"""Answers with a call and at the end, in each codec of language models."""
_FORMS: Final[Mapping[tuple[Codec, bool], str]] = {
    (Codec.LINES, False): "one action",
    (Codec.LINES, True): "the next actions, at most {count}, one a line",
    (Codec.JSON, False): "one action as a JSON object",
    (Codec.JSON, True): "the next actions, at most {count}, as a JSON array",
}
"""Form of an answer with one action, and with several."""
_SEEN: Final = (
    " You know only what the robot has seen: its camera looks all around, but not through walls, furniture and closed doors. "
    "Go to rooms, come near and open containers to find things."
)


def opening(situation: Situation, codec: Codec, *, seen: bool, at_once: int) -> Prompt:
    """Prompt at the start of an episode. With ``seen``, the situation holds only the rows that the robot has seen.

    ``at_once`` is the number of calls that an answer may have.
    """
    prompt = prompt_for(situation, codec)
    if codec is Codec.NAMES:
        return Prompt("", f"rooms {' '.join(situation.home)}\n{prompt.user}") if seen else prompt
    rooms = f"Rooms: {', '.join(situation.home)}\n" if seen else ""
    system = system_for_answers(codec, situation.profile, seen=seen, at_once=at_once)
    return Prompt(system, rooms + prompt.user)


def system_for_tools(profile: Profile, *, seen: bool) -> str:
    """System text for a model that calls the skills as tools instead of writing them."""
    return (
        "You control a home robot step by step: call one tool at a time, and you are told what happened. "
        f"When the task is fulfilled, answer {DONE} without a call. A failed call changes nothing.\n"
        f"{RULES}{ADDED_RULES[profile]}{_SEEN if seen else ''}"
    )


def system_for_answers(codec: Codec, profile: Profile, *, seen: bool, at_once: int) -> str:
    """System text for a language model that writes its calls, at most ``at_once`` in an answer."""
    call, end = EXAMPLES[codec]
    form = _FORMS[codec, at_once > 1].format(count=at_once)
    actions = (
        f"Actions: {skill_lines(profile)} | {DONE}"
        if codec is Codec.LINES
        else f"Actions:\n{skill_objects(profile)}\n{end}"
    )
    return (
        f"You control a home robot step by step. Answer only with {form}; you are told what happened and asked again. "
        f"Answer {end} when the task is fulfilled. A failed action changes nothing.\n"
        f"{actions}\n{RULES}{ADDED_RULES[profile]}{_SEEN if seen else ''}\nExample, open fridge 2: {call}"
    )


def answer_text(call: SkillCall | None, known: Situation, codec: Codec) -> str:
    """Answer with one call, or at the end if there is none, as a policy of this codec writes it."""
    match codec:
        case Codec.NAMES:
            return DONE if call is None else plan_in_names((call,), known)
        case _ if call is None:
            return EXAMPLES[codec][1]
        case Codec.LINES:
            return plan_to_lines((call,))
        case Codec.JSON:
            return json.dumps(plan_to_json((call,))[0])


def row_after(row: PromptRow, now: ObjectDescription, rows: Mapping[str, PromptRow]) -> PromptRow:
    """Return a row with another place and other states. A host that is not among the ``rows`` is left out."""
    if now.gone:
        return replace(row, host="", relation=None, states=(ABSENT,))
    hosted = now.host in rows and now.relation in PREPOSITIONS
    first = tuple(state for state in now.states if state in _FIRST)
    others = sorted(state.replace(" ", "_") for state in now.states if state not in _FIRST)
    return replace(
        row,
        room=now.room,
        host=now.host if hosted else "",
        relation=now.relation if hosted else None,
        states=(*first, *others),
    )


class Wording:
    """Words for objects in one codec. ``known`` are the rows that the policy knows, in a situation of the whole table."""

    def __init__(self, situation: Situation, codec: Codec, known: Callable[[int], bool]) -> None:
        self._rows = {row.name: row for row in situation.rows}
        self._home = set(situation.home)
        label = labels(situation)
        self._label = (lambda row: label[row.index]) if codec is Codec.NAMES else indexed
        self._known = known
        self._codec = codec

    def name(self, name: str) -> str:
        """Word for an object of the scene."""
        row = self._rows.get(name)
        if row is None:
            return name.rpartition("_")[0].replace("_", " ")
        return self._label(row) if self._known(row.index) else UNKNOWN

    def outcome(self, step: Step) -> str:
        """Return a step's message with the policy's words for objects. Names of rooms stay."""
        if step.failure is FailureReason.UNKNOWN_ROOM:
            # It repeats the policy's own word, which may be the name of an object that it has not seen.
            return step.message
        return _NAME.sub(
            lambda found: found[0] if found[0] in self._home else self.name(found[0]), step.message
        )

    def row(self, row: PromptRow) -> str:
        """Name, states and place of a row: ``apple 4 hot, in fridge 2``."""
        words = " ".join([self._label(row), *row.states])
        if row.host and row.relation is not None:
            place = f"{PREPOSITIONS[row.relation]} {self.name(row.host)}"
        else:
            place = f"in {row.room}" if row.room else ""
        separator = " " if self._codec is Codec.NAMES else ", "
        return separator.join(filter(None, [words, place]))

    def call(self, call: SkillCall) -> str:
        """Call as a policy writes it, without JSON."""
        if self._codec is not Codec.NAMES:
            return words_of(call, str)
        by_index = {row.index: row for row in self._rows.values()}
        return words_of(
            call,
            lambda index: (
                self._label(by_index[index]) if index in by_index and self._known(index) else UNKNOWN
            ),
        )


def not_an_action(error: PlanError, codec: Codec) -> str:
    """Sentence about an answer that is neither a call nor ``DONE``."""
    call, end = EXAMPLES.get(codec, EXAMPLES[Codec.LINES])
    if error.reason is PlanReason.NO_PLAN:
        return f"Not an action: expected one on a line of its own, such as {call}, or {end}"
    reason = str(error).removeprefix("step 1: ").replace("a row of the object table", "that of an object")
    also = f", {DONE}" if error.reason is PlanReason.UNKNOWN_SKILL else ""
    return f"Not an action: {reason}{also}"


def left_out(found: int, tried: int) -> str:
    """Sentence about an answer with more calls than were tried."""
    done = "one was" if tried == 1 else f"{tried} were"
    return f"Of {found} actions, the first {done} tried, and the others left out."


def observation_text(
    wording: Wording,
    codec: Codec,
    steps: Sequence[Step],
    new: Sequence[PromptRow],
    changed: Sequence[PromptRow],
    situation: Situation,
    notes: Sequence[str] = (),
) -> str:
    """Text after an answer: the outcome of its calls, what the robot sees for the first time, what changed, and the robot.

    ``situation`` is what the policy knows now. ``notes`` are sentences about the answer itself.
    """
    if codec is Codec.NAMES:
        return _in_names(wording, steps, new, changed, situation, notes)
    lines = [*notes]
    for step in steps:
        failed = "" if step.failure is None else f"failed ({step.failure}): "
        lines.append(f"{wording.call(step.call)}: {failed}{wording.outcome(step)}")
    if new:
        lines.append(f"New: {'; '.join(map(wording.row, new))}")
    if changed:
        lines.append(f"Changed: {'; '.join(map(wording.row, changed))}")
    held = [" ".join([indexed(row), *row.states]) for row in held_rows(situation)]
    lines.append(robot_in_words(situation.robot_room, held))
    return "\n".join(lines)


def _in_names(
    wording: Wording,
    steps: Sequence[Step],
    new: Sequence[PromptRow],
    changed: Sequence[PromptRow],
    situation: Situation,
    notes: Sequence[str],
) -> str:
    """Short text of words: ``failed blocked fridge``, then rows, then the robot."""
    lines = [f"{FAILED} {UNPARSABLE}"] if notes and not steps else []
    for step in steps:
        if step.failure is None:
            lines.append(DID)
        else:
            blocker = [wording.name(step.blocker)] if step.blocker else []
            lines.append(" ".join([FAILED, step.failure.value, *blocker]))
    lines += map(wording.row, (*new, *changed))
    hand = ["holds", *(wording.name(row.name) for row in held_rows(situation))] if situation.held else []
    lines.append(" ".join(["robot", situation.robot_room, *hand]))
    return "\n".join(lines)
