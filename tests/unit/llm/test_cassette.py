"""Recorded answers replace the model, and the ledger accounts for questions."""

import json
from dataclasses import replace

import pytest
from tests.fakes.chat_server import ChatServer

from embomatrix.llm.cassette import Cassette, digest
from embomatrix.llm.endpoint import Endpoint, EndpointLimits
from embomatrix.llm.ledger import Ledger, Price
from embomatrix.llm.values import CassetteError, ChatRequest, EndpointError, Message, Speaker

QUESTION = ChatRequest("cast", (Message(Speaker.USER, "Who?", (b"png",)),))
OTHER = replace(QUESTION, messages=(Message(Speaker.USER, "Where?"),))


async def recorded(path, *questions):
    server = ChatServer("Ann.", "Bo.", "Cy.")
    with server.serving() as url:
        async with Endpoint(url, "small-1") as endpoint:
            cassette = Cassette(path, endpoint)
            return [(await cassette.complete(question)).text for question in questions], len(server.requests)


async def replayed(path, *questions):
    cassette = Cassette(path)
    return [(await cassette.complete(question)).text for question in questions]


async def test_recorded_answers_are_replayed_in_order(tmp_path):
    path = tmp_path / "tapes" / "cast.jsonl"
    assert await recorded(path, QUESTION, OTHER, QUESTION) == (["Ann.", "Bo.", "Cy."], 3)
    assert await replayed(path, QUESTION, QUESTION, OTHER) == ["Ann.", "Cy.", "Bo."]


async def test_only_unrecorded_questions_are_asked(tmp_path):
    path = tmp_path / "cast.jsonl"
    await recorded(path, QUESTION)
    texts, asked = await recorded(path, QUESTION, OTHER)
    assert (texts, asked) == (["Ann.", "Ann."], 1)
    assert len(path.read_text().splitlines()) == 2


async def test_changed_question_is_reported(tmp_path):
    path = tmp_path / "cast.jsonl"
    await recorded(path, QUESTION)
    with pytest.raises(
        CassetteError, match=r"cast: the cassette .* has no answer 1 to question .* record it again"
    ):
        await replayed(path, OTHER)


FIELDS = '"question": "q", "number": 0, "text": "", "model": "", "completion_tokens": 0, "finish": ""'


@pytest.mark.parametrize(
    "line",
    [
        b"{",
        b"[]",
        b'{"question": 3}',
        b"[" * 100_000,
        b'"\xff"',
        f'{{{FIELDS}, "prompt_tokens": 1e999}}'.encode(),
    ],
)
async def test_damaged_line_is_reported(tmp_path, line):
    path = tmp_path / "cast.jsonl"
    await recorded(path, QUESTION)
    with path.open("ab") as file:
        file.write(line + b"\n")
    with pytest.raises(CassetteError, match="line 2, is not a recorded answer"):
        Cassette(path)


async def test_answer_with_any_line_separator_is_replayed(tmp_path):
    text = "one\u2028two\x85three\x1cfour"
    with ChatServer(text).serving() as url:
        async with Endpoint(url, "small-1") as endpoint:
            await Cassette(tmp_path / "cast.jsonl", endpoint).complete(QUESTION)
    assert await replayed(tmp_path / "cast.jsonl", QUESTION) == [text]


def test_missing_cassette_without_a_model_is_refused(tmp_path):
    with pytest.raises(CassetteError, match="record one first"):
        Cassette(tmp_path / "none.jsonl")


@pytest.mark.parametrize(
    "changed",
    [
        replace(QUESTION, seed=1),
        replace(QUESTION, temperature=0.1),
        replace(QUESTION, messages=(Message(Speaker.USER, "Who?", (b"gif",)),)),
    ],
)
def test_digest_covers_the_question_but_not_its_purpose(changed):
    assert digest(changed) != digest(QUESTION)
    assert digest(replace(QUESTION, purpose="someone else")) == digest(QUESTION)


async def test_ledger_sums_cost_by_purpose(tmp_path):
    server = ChatServer("Ann is here.", "Bo.", (400, {}, "no", 0.0))
    path = tmp_path / "ledger.jsonl"
    with server.serving() as url:
        async with Endpoint(url, "small-1", limits=EndpointLimits(attempts=1)) as endpoint:
            ledger = Ledger(endpoint, price=Price(1.0, 10.0), path=path)
            await ledger.complete(QUESTION)
            await ledger.complete(replace(OTHER, purpose="dialogue"))
            with pytest.raises(EndpointError):
                await ledger.complete(QUESTION)
    assert ledger.accounts["cast"].calls == 1
    assert ledger.accounts["cast"].failed == 1
    assert ledger.accounts["cast"].cost == pytest.approx((11 + 30) / 1e6)
    assert ledger.total().prompt_tokens == 22
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["purpose"] for line in lines] == ["cast", "dialogue", "cast"]
    assert "answered 400" in lines[2]["failed"]
