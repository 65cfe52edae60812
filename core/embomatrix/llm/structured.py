"""Typed answers: a reply is read as JSON and validated; the model is asked again with the error. Text is never evaluated."""

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Final, TypeVar

from pydantic import BaseModel, ValidationError

from embomatrix.llm.values import ChatModel, ChatRequest, Message, Reply, Speaker, UnusableReplyError
from embomatrix.world.json_text import check_characters

T = TypeVar("T", bound=BaseModel)

MAX_STARTS: Final = 256
"""Most brackets at which the reader looks for JSON: bounds the work on adversarial text."""
SHOWN_PROBLEMS: Final = 5
_FENCE: Final = re.compile(r"```(?:json)?[^\S\n]*\n(.*?)```", re.DOTALL)
_BRACKET: Final = re.compile(r"[{\[]")


async def ask(
    model: ChatModel,
    request: ChatRequest,
    shape: type[T],
    *,
    check: Callable[[T], None] | None = None,
    attempts: int = 3,
) -> T:
    """Ask until the answer has the shape and passes ``check``, which raises ValueError with a message for the model.

    Raises UnusableReplyError after ``attempts`` answers, EndpointError without an answer.
    """
    request = replace(request, json_schema=request.json_schema or shape.model_json_schema())
    problem = ""
    for _ in range(attempts):
        reply = await model.complete(request)
        try:
            value = read_json(reply.text, shape)
            if check is not None:
                check(value)
            return value
        except ValueError as error:
            problem = str(error)
        if reply.finish == "length":
            problem = f"the answer was cut off after {request.max_tokens} tokens: {problem}"
        request = replace(request, messages=(*request.messages, *_objection(reply, problem)))
    raise UnusableReplyError(
        f"{request.purpose}: {attempts} answers of {reply.model}, none usable, the last because {problem}"
    )


def _objection(reply: Reply, problem: str) -> tuple[Message, Message]:
    return (
        Message(Speaker.ASSISTANT, reply.text),
        Message(Speaker.USER, f"That can't be used: {problem}. Answer again, with the corrected JSON only."),
    )


def read_json(text: str, shape: type[T]) -> T:
    """Return the first JSON value in the text that has the shape. Raises ValueError with a sentence.

    The reader skips closed reasoning, then looks in code fences, then anywhere in the text.
    """
    answer = text.rpartition("</think>")[2]
    answer = answer if answer.strip() else text
    first_problem = ""
    for value, damaged in _json_values(answer):
        try:
            check_characters(value)
            return shape.model_validate(value)
        except ValidationError as error:
            # Complete parts of a damaged answer are not the answer.
            first_problem = first_problem or (
                "its JSON is damaged, or breaks off" if damaged else _problems(error)
            )
        except ValueError as error:
            first_problem = first_problem or str(error)
    raise ValueError(first_problem or "it holds no complete JSON value")


def _json_values(text: str) -> Iterator[tuple[Any, bool]]:
    """Yield JSON objects and arrays in the text, with a flag for unreadable brackets before them.

    Fenced values come first. A value inside another one is not yielded.
    """
    decoder = json.JSONDecoder()
    for part in (*(match[1] for match in _FENCE.finditer(text)), text):
        at, starts, damaged = 0, 0, False
        while starts < MAX_STARTS and (bracket := _BRACKET.search(part, at)) is not None:
            starts += 1
            try:
                value, at = decoder.raw_decode(part, bracket.start())
            except (ValueError, RecursionError):
                at, damaged = bracket.end(), True
                continue
            yield value, damaged


def _problems(error: ValidationError) -> str:
    """Describe validation errors field by field, for the model."""
    found = [
        f"{'.'.join(map(str, problem['loc'])) or 'the value'}: {problem['msg'][:1].lower()}{problem['msg'][1:]}"
        for problem in error.errors(include_url=False)[:SHOWN_PROBLEMS]
    ]
    more = error.error_count() - len(found)
    return "; ".join(found) + (f"; and {more} more" if more > 0 else "")
