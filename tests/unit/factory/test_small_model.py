"""Social agents with recorded answers of a small local model: invalid answers are caught."""

import asyncio
import json
import re
from typing import Any

import pytest
from tests.fakes.small_model import RECORDING, ask_everything

from embomatrix.factory.social.model_agents import CAST, SUMMARY, TALK, ConversationAnswer
from embomatrix.factory.social.prompts import answer_schema
from embomatrix.factory.social.requests import TaskRequest
from embomatrix.factory.social.values import Cast, Conversation
from embomatrix.llm.cassette import Cassette
from embomatrix.llm.values import UnusableReplyError

SHAPES = {"cast": Cast, "converse": Conversation, "summarise": TaskRequest}


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
    assert len(by_agent) == len(SHAPES)
    # A repeated request contains the objection and is therefore longer.
    for asked in by_agent.values():
        lengths = [answer["prompt_tokens"] for answer in asked]
        assert lengths == sorted(lengths)
        assert len({answer["question"] for answer in asked}) == len(asked)


def test_recording_is_small_and_holds_no_secret():
    text = RECORDING.read_text(encoding="utf-8")
    assert len(text) < 40_000
    assert not re.search(r"sk-[A-Za-z0-9]{8}|Bearer |api[_-]?key|/home/|/tmp/", text)


def expanded(node: Any, definitions: dict[str, Any]) -> Any:
    """Return a schema without titles and descriptions, with its references replaced by what they name."""
    if isinstance(node, list):
        return [expanded(item, definitions) for item in node]
    if not isinstance(node, dict):
        return node
    if "$ref" in node:
        return expanded(definitions[node["$ref"].rpartition("/")[2]], definitions)
    return {
        key: {name: expanded(inner, definitions) for name, inner in value.items()}
        if key == "properties"
        else expanded(value, definitions)
        for key, value in node.items()
        if key not in ("title", "description", "$defs")
    }


@pytest.mark.parametrize(
    ("purpose", "shape"), [(CAST, Cast), (TALK, ConversationAnswer), (SUMMARY, TaskRequest)]
)
def test_stored_answer_schema_matches_the_model_class(purpose, shape):
    stored, derived = answer_schema(purpose), shape.model_json_schema()
    assert expanded(stored, stored.get("$defs", {})) == expanded(derived, derived.get("$defs", {}))
