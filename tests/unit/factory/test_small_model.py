"""Social agents with recorded answers of a small local model: invalid answers are caught."""

import asyncio
import json
import re

from tests.fakes.small_model import RECORDING, ask_everything

from embomatrix.factory.social.model.agents import DAY, PEOPLE, READING, SUMMARY, TURN
from embomatrix.factory.social.model.answers import Household, ReadingAnswer, SummaryAnswer
from embomatrix.factory.social.values import DialogueTurn
from embomatrix.llm.cassette import Cassette
from embomatrix.llm.values import UnusableReplyError

SHAPES = {
    "people": Household,
    "plan_day": tuple,
    "person_turn": DialogueTurn,
    "robot_turn": DialogueTurn,
    "summarise": SummaryAnswer,
    "demands": ReadingAnswer,
}


def test_each_agent_returns_a_value_or_reports_the_problem():
    found = asyncio.run(ask_everything(Cassette(RECORDING)))
    assert set(found) == set(SHAPES)
    for name, value in found.items():
        if isinstance(value, UnusableReplyError):
            assert re.search(r"answers of .+, none usable, the last because .+", str(value))
        else:
            assert isinstance(value, SHAPES[name])


def test_problem_is_quoted_to_the_model_which_answers_again():
    answers = [json.loads(line) for line in RECORDING.read_text(encoding="utf-8").splitlines()]
    by_agent = {}
    for answer in answers:
        by_agent.setdefault(answer["purpose"], []).append(answer)
    assert set(by_agent) == {PEOPLE, DAY, TURN, SUMMARY, READING}
    for purpose, asked in by_agent.items():
        lengths = [answer["prompt_tokens"] for answer in asked]
        # Person and robot share the purpose of a turn. The recording asks the person first.
        parts = (lengths[:2], lengths[2:]) if purpose == TURN else (lengths,)
        # A repeated request contains the objection and is therefore longer.
        assert all(part == sorted(set(part)) for part in parts)
        assert len({answer["question"] for answer in asked}) == len(asked)


def test_recording_is_small_and_holds_no_secret():
    text = RECORDING.read_text(encoding="utf-8")
    assert len(text) < 40_000
    assert not re.search(r"sk-[A-Za-z0-9]{8}|Bearer |api[_-]?key|/home/|/tmp/", text)
