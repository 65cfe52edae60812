"""Parser and writer of plans in a model's text. Text is data and is never evaluated.

The parser accepts two forms. JSON: an array of calls, or an object that holds one under "action_sequence" or "plan", in a
code fence or among prose. Arguments stand beside the action or under "parameters". The last plan of the text counts, because
a model reasons first and answers last. Compact: calls on lines or between semicolons, ``move 3; place 3 inside``, with
arguments in the order of ``SIGNATURES``. Skills outside the task's profile count as unknown.
"""

import itertools
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from enum import StrEnum
from typing import Any, Final, cast

from embomatrix.skills.syntax import (
    ALIASES,
    MAX_PLAN_BYTES,
    MAX_ROOM_NAME,
    MAX_STEPS,
    PROFILES,
    SIGNATURES,
    Arg,
    PlaceRelation,
    Plan,
    Skill,
    SkillCall,
)
from embomatrix.world.task import Profile


class PlanReason(StrEnum):
    """Reason why a text is not a plan. Each earns the reward of unparsable text."""

    TOO_LONG = "too_long"
    NO_PLAN = "no_plan"
    TOO_MANY_STEPS = "too_many_steps"
    UNKNOWN_SKILL = "unknown_skill"
    MISSING_ARGUMENT = "missing_argument"
    WRONG_ARGUMENT = "wrong_argument"


class PlanError(ValueError):
    """Raised for a text that is not a plan. The message is a sentence for people."""

    def __init__(self, reason: PlanReason, sentence: str) -> None:
        super().__init__(sentence)
        self.reason = reason


PLAN_KEYS: Final = ("action_sequence", "plan")
DONE: Final = "done"
"""Answer that ends an episode."""
MAX_INDEX: Final = 2**63 - 1
"""Largest index that the wire format carries."""
_MAX_STARTS: Final = 256
"""Most brackets at which the parser looks for JSON."""
_READ_TIMES: Final = 8
"""Most characters that failed attempts may read, as a multiple of the text: nested brackets that never close are
read again from each bracket."""
_JSON_START: Final = re.compile(r"\[\s*\{|\{\s*\"")
_LIST_MARK: Final = re.compile(r"^\s*(?:\d+[.)]|[-*])\s+")
_AROUND: Final = " \t`*.!"
_ANSWER_MARK: Final = re.compile(r"^(?:(?:next )?action|answer)\s*:\s*", re.IGNORECASE)
_CALL_IN_BRACKETS: Final = re.compile(r"([A-Za-z_]+)\(([^()]*)\)")
_WORD: Final = re.compile(r"[A-Za-z_]+")
_ARGUMENT: Final = re.compile(
    r"[-+]?(?:\d[\d.]*(?:e[-+]?\d+)?|nan|inf|infinity)|ontop|inside|under|nextto", re.IGNORECASE
)


def parse_plan(text: str, profile: Profile = Profile.PAPER) -> Plan:
    """Return the last plan in the text. Raises PlanError, and no other exception, for any text."""
    answer = _answer_in(text)
    value = last_json_plan(answer, json.JSONDecoder())
    if value is not None:
        return plan_from_json(value, profile)
    return _parse_lines(answer, profile)


def parse_answer(text: str, profile: Profile = Profile.PAPER) -> tuple[Plan, bool]:
    """Return the calls of an answer within an episode, and whether ``DONE`` follows them.

    The forms are those of a plan, and JSON objects with one call each, one after another. ``DONE`` is a line, or the action of
    a JSON call; what follows it is left out. Raises PlanError, and no other exception, for a text with neither.
    """
    answer = _answer_in(text)
    values = _json_calls(answer)
    if values is not None:
        before = [*itertools.takewhile(lambda step: not _is_done(step), values)]
        done = len(before) < len(values)
        return (plan_from_json(before, profile) if before or not done else ()), done
    segments = [words for line in _plain_lines(answer) for words in _segments(line)]
    lines = [*itertools.takewhile(lambda words: not _ends(words), segments)]
    done = len(lines) < len(segments)
    if done and not any(_is_call(words, profile) for words in lines):
        return (), True
    return _parse_lines("\n".join(map(" ".join, lines)) if lines else answer, profile), done


def prose_lines(text: str, profile: Profile) -> list[str]:
    """Return the parts of a text that ``parse_plan`` passes over as prose; none for a text with a JSON plan."""
    answer = _without_reasoning(text)
    if last_json_plan(answer, json.JSONDecoder()) is not None:
        return []
    return [" ".join(words) for words in _segments(answer) if not _is_call(words, profile)]


def plan_from_json(value: object, profile: Profile = Profile.PAPER) -> Plan:
    """Return the plan in a decoded JSON value: an array of calls, or an object that holds one. Raises PlanError."""
    steps = _steps_in(value)
    if steps is None:
        raise PlanError(
            PlanReason.NO_PLAN,
            'expected a JSON array of calls such as [{"action": "move", "object_index": 0}]',
        )
    _check_length(len(steps))
    return tuple(_call_from_json(step, number, profile) for number, step in enumerate(steps, start=1))


def plan_to_json(plan: Plan) -> list[dict[str, object]]:
    """Return JSON values that ``plan_from_json`` reads back to an equal plan."""
    return [
        {"action": call.skill.value, **{arg.value: argument(call, arg) for arg in SIGNATURES[call.skill]}}
        for call in plan
    ]


def plan_to_lines(plan: Plan) -> str:
    """Return compact text, one call a line, that ``parse_plan`` reads back to an equal plan."""
    return "\n".join(
        " ".join([call.skill.value, *(str(argument(call, arg)) for arg in SIGNATURES[call.skill])])
        for call in plan
    )


def argument(call: SkillCall, arg: Arg) -> int | float | str | None:
    """Return the call's value for an argument as a plain JSON value, None if the skill does not take it."""
    value = cast("int | float | str | None", getattr(call, arg.value))
    return value.value if isinstance(value, PlaceRelation) else value


def _answer_in(text: str) -> str:
    """Return the text without its reasoning. Raises PlanError for one that is too long."""
    size = len(text.encode("utf-8", errors="replace"))
    if size > MAX_PLAN_BYTES:
        raise PlanError(
            PlanReason.TOO_LONG,
            f"the text has {size} bytes: expected at most {MAX_PLAN_BYTES}; shorten the plan",
        )
    return _without_reasoning(text)


def _plain_lines(answer: str) -> Iterator[str]:
    """Yield the lines without the marks that models put around a call: `` `open 2` ``, ``Action: open 2``, ``open(2)``."""
    for line in answer.splitlines():
        plain = _ANSWER_MARK.sub("", line.strip(_AROUND)).strip(_AROUND)
        call = _CALL_IN_BRACKETS.fullmatch(plain)
        yield f"{call[1]} {call[2].replace(',', ' ')}" if call else plain


def _calls_in(value: object) -> Sequence[object] | None:
    """Return the array of calls in a JSON value, that of a single call included; None if there is none."""
    if isinstance(value, dict) and isinstance(value.get("action"), str):
        return [value]
    return _steps_in(value)


def _is_done(value: object) -> bool:
    action = value.get("action") if isinstance(value, dict) else None
    return isinstance(action, str) and _ends(action.split())


def _ends(words: Sequence[str]) -> bool:
    return len(words) == 1 and words[0].lower().rstrip(".!") == DONE


def _without_reasoning(text: str) -> str:
    """Return the text after the last </think>, or all of it if nothing follows."""
    answer = text.rpartition("</think>")[2]
    return answer if answer.strip() else text


def _check_length(count: int) -> None:
    if count == 0:
        raise PlanError(PlanReason.NO_PLAN, "the plan is empty: expected at least one skill call")
    if count > MAX_STEPS:
        raise PlanError(
            PlanReason.TOO_MANY_STEPS, f"the plan has {count} steps: expected at most {MAX_STEPS}; shorten it"
        )


def _steps_in(value: object) -> Sequence[object] | None:
    """Return the array of calls in a JSON value, None if there is none."""
    if isinstance(value, dict):
        return next((value[key] for key in PLAN_KEYS if isinstance(value.get(key), list)), None)
    if isinstance(value, list) and any(isinstance(item, dict) and "action" in item for item in value):
        return value
    return None


def _json_calls(answer: str) -> Sequence[object] | None:
    """Return the last calls in JSON: those of an array, or of objects with nothing but commas and spaces between them."""
    found: Sequence[object] | None = None
    ended, is_single = 0, False
    for start, end, value in _json_values(answer, json.JSONDecoder()):
        calls = _calls_in(value)
        if calls is None:
            continue
        was_single, is_single = is_single, isinstance(value, dict) and _steps_in(value) is None
        follows = was_single and is_single and not answer[ended:start].strip(" \t\r\n,;")
        found = [*(found or ()), *calls] if follows else calls
        ended = end
    return found


def last_json_plan(text: str, decoder: json.JSONDecoder) -> object | None:
    """Return the last outermost JSON value that holds a plan. Reads about ``_READ_TIMES`` times the text at most."""
    found: object | None = None
    for _, _, value in _json_values(text, decoder):
        if _steps_in(value) is not None:
            found = value
    return found


def _json_values(text: str, decoder: json.JSONDecoder) -> Iterator[tuple[int, int, object]]:
    """Yield the outermost JSON arrays of objects and objects, each with its start and end in the text."""
    position, left = 0, _READ_TIMES * len(text)
    for _ in range(_MAX_STARTS):
        match = _JSON_START.search(text, position)
        if match is None or left < 0:
            break
        try:
            value, position = decoder.raw_decode(text, match.start())
        except (ValueError, RecursionError) as error:
            left -= _end_of_failure(error, text) - match.start()
            position = match.start() + 1
            continue
        yield match.start(), position, value


def _end_of_failure(error: Exception, text: str) -> int:
    """Return the index up to which the decoder has read; the text's end where the error does not tell."""
    if isinstance(error, json.JSONDecodeError) and not error.msg.startswith("Unterminated"):
        return error.pos
    return len(text)


def _call_from_json(value: object, number: int, profile: Profile) -> SkillCall:
    """Read one call. Unknown keys, such as comments, are ignored."""
    if not isinstance(value, dict) or "action" not in value:
        raise PlanError(
            PlanReason.MISSING_ARGUMENT,
            f'step {number} has no "action": add the name of a skill, as in {{"action": "move", "object_index": 0}}',
        )
    nested = value.get("parameters", {})
    if not isinstance(nested, dict):
        raise PlanError(
            PlanReason.WRONG_ARGUMENT,
            f'step {number}: "parameters" is a {_shown(nested)}: expected an object such as {{"object_index": 0}}',
        )
    given = {**nested, **value}
    aliased = {arg.value: given[alias] for alias, arg in ALIASES.items() if alias in given}
    return _build_call(_skill(value["action"], number, profile), {**aliased, **given}, number)


def _parse_lines(text: str, profile: Profile) -> Plan:
    """Read the lines that are calls; other lines are prose."""
    calls = [words for words in _segments(text) if _is_call(words, profile)]
    if not calls:
        raise PlanError(
            PlanReason.NO_PLAN,
            f"no plan was found ({_found_instead(text)}): expected a JSON array of calls such as "
            '[{"action": "move", "object_index": 0}], or lines such as "move 0"',
        )
    _check_length(len(calls))
    return tuple(_call_from_words(words, number, profile) for number, words in enumerate(calls, start=1))


def _found_instead(text: str) -> str:
    """Describe a text without a plan, for an error message."""
    content = text.strip()
    if not content:
        return "the text is empty"
    if content[0] not in "[{":
        return f"the text begins with {_shown(content)}"
    try:
        json.loads(content)
    except json.JSONDecodeError as error:
        return f"its JSON is invalid at line {error.lineno}, column {error.colno}: {error.msg}"
    except (ValueError, RecursionError):
        return "its JSON can't be read"
    return "its JSON contains no array of calls"


def _segments(text: str) -> Iterator[list[str]]:
    for segment in re.split(r"[\n\r;]", text):
        words = _LIST_MARK.sub("", segment).split()
        if words:
            yield words


def _is_call(words: list[str], profile: Profile) -> bool:
    """True for a known skill with at most two words after it, or any word with only numbers and relations after it."""
    skill, *arguments = words
    if skill.lower() in PROFILES[profile] and len(arguments) <= 2:
        return True
    return bool(_WORD.fullmatch(skill) and arguments and all(_ARGUMENT.fullmatch(item) for item in arguments))


def _call_from_words(words: list[str], number: int, profile: Profile) -> SkillCall:
    skill = _skill(words[0], number, profile)
    expected = SIGNATURES[skill]
    if len(words) - 1 > len(expected):
        raise PlanError(
            PlanReason.WRONG_ARGUMENT,
            f"step {number}: found {_shown(' '.join(words))}: expected `{_signature(skill)}`",
        )
    values = {arg.value: _number_or_word(word) for arg, word in zip(expected, words[1:], strict=False)}
    return _build_call(skill, values, number)


def _number_or_word(word: str) -> int | float | str:
    for number in (int, float):
        try:
            return number(word)
        except ValueError:
            continue
    return word


def _skill(value: object, number: int, profile: Profile) -> Skill:
    known = {skill.value: skill for skill in PROFILES[profile]}
    skill = known.get(value.strip().lower()) if isinstance(value, str) else None
    if skill is None:
        raise PlanError(
            PlanReason.UNKNOWN_SKILL,
            f"step {number}: found the unknown skill {_shown(value)}: expected one of {', '.join(known)}",
        )
    return skill


def _build_call(skill: Skill, values: Mapping[str, object], number: int) -> SkillCall:
    arguments: dict[str, int | float | str] = {}
    for arg in SIGNATURES[skill]:
        if values.get(arg.value) is None:
            raise PlanError(
                PlanReason.MISSING_ARGUMENT,
                f"step {number}: {skill.value} has no {arg.value}: expected `{_signature(skill)}`",
            )
        arguments[arg.value] = _checked(arg, values[arg.value], number)
    return SkillCall(skill, **cast("dict[str, Any]", arguments))


def _checked(arg: Arg, value: object, number: int) -> int | float | str:
    """Return the value in its type. Raises PlanError; a boolean is not a number here."""
    match arg:
        case Arg.OBJECT | Arg.SOURCE:
            if isinstance(value, int) and not isinstance(value, bool) and abs(value) <= MAX_INDEX:
                return value
            expected = "a whole number, a row of the object table"
        case Arg.YAW | Arg.DISTANCE:
            real = _finite(value)
            if real is not None:
                return real
            expected = "a finite number"
        case Arg.RELATION:
            if isinstance(value, str) and value.strip().lower() in set(PlaceRelation):
                return PlaceRelation(value.strip().lower())
            expected = f"one of {', '.join(PlaceRelation)}"
        case Arg.ROOM:
            if isinstance(value, str) and 0 < len(value.strip()) <= MAX_ROOM_NAME and _is_unicode(value):
                return value.strip()
            expected = "the name of a room"
    raise PlanError(
        PlanReason.WRONG_ARGUMENT, f"step {number}: {arg.value} is {_shown(value)}: expected {expected}"
    )


def _is_unicode(text: str) -> bool:
    """False for a text with half a surrogate pair, which JSON can escape and no message can carry."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def _finite(value: object) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        real = float(value)
    except OverflowError:
        return None
    return real if math.isfinite(real) else None


def _signature(skill: Skill) -> str:
    return " ".join([skill.value, *(arg.value for arg in SIGNATURES[skill])])


def _shown(value: object) -> str:
    """Format a value for an error message, at most 60 characters."""
    if isinstance(value, int) and abs(value) > MAX_INDEX:
        return "a number beyond 64 bits"
    text = repr(value) if isinstance(value, str | int | float | bool | None) else type(value).__name__
    return text if len(text) <= 60 else text[:57] + "..."
