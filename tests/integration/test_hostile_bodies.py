"""Bodies and answers that would stop the manager: unfinished, too large, or slow to parse."""

import asyncio

import httpx
import pytest
from fastapi import HTTPException, Request

from embomatrix.manager.web.bodies import LARGEST_BYTES, BodyBudget
from embomatrix.manager.web.parsing import AnswerParser
from embomatrix.rpc.status import InvalidRequestError, UnavailableError


def request_of(*chunks, address="10.0.0.1", ends=True, leaves=False):
    """Return a request whose body comes in these chunks, and never ends unless it ``ends`` or its sender ``leaves``."""
    waiting = list(chunks)

    async def receive():
        if leaves and not waiting:
            return {"type": "http.disconnect"}
        if waiting:
            body = waiting.pop(0)
            return {"type": "http.request", "body": body, "more_body": bool(waiting) or leaves or not ends}
        return await asyncio.Event().wait()

    return Request({"type": "http", "method": "POST", "headers": [], "client": (address, 1)}, receive)


async def status_of(budget, request):
    with pytest.raises(HTTPException) as refused:
        await budget.receive(request)
    return refused.value.status_code


async def test_body_that_never_ends_is_given_up_and_its_bytes_are_free_again():
    budget = BodyBudget(body_s=0.05, all_bytes=100)
    assert await status_of(budget, request_of(b"x" * 90, ends=False)) == 408
    assert await budget.receive(request_of(b"x" * 90)) == b"x" * 90


async def test_body_whose_sender_leaves_is_no_error_of_the_manager_and_its_bytes_are_free_again():
    budget = BodyBudget(all_bytes=100)
    assert await status_of(budget, request_of(b"x" * 90, leaves=True)) == 400
    assert await budget.receive(request_of(b"x" * 90)) == b"x" * 90


async def test_body_that_is_too_large_is_refused():
    assert await status_of(BodyBudget(), request_of(b"x" * LARGEST_BYTES, b"y")) == 413


async def test_bodies_share_a_budget_until_they_are_released():
    budget = BodyBudget(all_bytes=100)
    first = request_of(b"x" * 60)
    await budget.receive(first)
    assert await status_of(budget, request_of(b"x" * 60, address="10.0.0.2")) == 503
    budget.release(first, 60)
    assert await budget.receive(request_of(b"x" * 60, address="10.0.0.2"))


async def test_one_address_has_a_budget_of_its_own():
    budget = BodyBudget()
    for _ in range(2):
        await budget.receive(request_of(b"x" * LARGEST_BYTES))
    assert await status_of(budget, request_of(b"x")) == 429
    assert await budget.receive(request_of(b"x", address="10.0.0.2")) == b"x"


async def test_answers_are_parsed_in_another_process_while_the_event_loop_runs():
    parser = AnswerParser()
    label = '{"task_id": "t", "bundle_digest": "d", "profile": "paper", "seed": 1}'
    body = httpx.Request(
        "POST", "http://x", json={"query": ["p move 3", "p no"], "prompts": ["p", "p"], "labels": [label] * 2}
    ).content
    try:
        (_, plan), (_, none) = await parser.parse(body)
        assert [call.object_index for call in plan] == [3]
        assert none is None
        with pytest.raises(InvalidRequestError, match="expected a JSON object"):
            await parser.parse(b"[")
    finally:
        parser.close()


async def test_slow_request_does_not_end_those_behind_it(monkeypatch):
    parser = AnswerParser()
    running, at_once = 0, []

    async def parse(body):
        nonlocal running
        running += 1
        at_once.append(running)
        await asyncio.sleep(0.01)
        running -= 1
        if body == b"slow":
            raise UnavailableError("the answers could not be parsed")
        return [body]

    monkeypatch.setattr(parser, "_parse", parse)
    found = await asyncio.gather(
        *(parser.parse(body) for body in (b"slow", b"one", b"two")), return_exceptions=True
    )
    assert isinstance(found[0], UnavailableError)
    assert found[1:] == [[b"one"], [b"two"]]
    assert at_once == [1, 1, 1]


async def test_parser_that_takes_too_long_is_ended_and_starts_anew():
    parser = AnswerParser(parse_s=0.0)
    with pytest.raises(UnavailableError, match="send fewer at once"):
        await parser.parse(b"{}")
    later = AnswerParser()
    try:
        with pytest.raises(InvalidRequestError):
            await later.parse(b"{}")
    finally:
        later.close()
