"""Sanitising for EAI's judge: pure JSON of plain names for any model text, because the judge's parser calls eval."""

import ast
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.trainer.eai.sanitise import sanitise_answer

STEP = {"action": "OPEN", "object": "fridge_97"}


@pytest.mark.parametrize(
    "text",
    [
        json.dumps([STEP]),
        f"<think>first [this], then that</think>\n```json\n{json.dumps([STEP])}\n```",
        f"[1, 2] is no plan, but {json.dumps([STEP])} is [indeed]",
        f'[{{"action": "CLOSE", "object": "x"}}] or rather {json.dumps([STEP])}',
        "[{'action': 'OPEN', 'object': 'fridge_97'}]",
        json.dumps([{**STEP, "why": "__import__('os').system('true')"}]),
    ],
)
def test_steps_are_extracted_from_model_output(text):
    assert json.loads(sanitise_answer(text)) == [STEP]


@pytest.mark.parametrize(
    "text", ["", "I can't.", "[", "[]", "[[[", '["OPEN"]', '[{"action": "OPEN"}]', "[" * 100_000]
)
def test_text_without_steps_is_empty(text):
    assert sanitise_answer(text) == ""


def test_characters_that_could_break_out_are_removed_from_names():
    text = json.dumps([{"action": "OPEN", "object": 'a"]) or __import__("os")#'}])
    assert json.loads(sanitise_answer(text)) == [{"action": "OPEN", "object": "a??? or __import__??os???"}]


@given(st.text(), st.text())
def test_sanitised_text_is_a_literal_up_to_the_first_closing_bracket(action, thing):
    """The published parser evaluates the text from the first "[" to the first "]"."""
    text = sanitise_answer(json.dumps([{"action": action, "object": thing}]))
    value = ast.literal_eval(text[text.find("[") : text.find("]") + 1])
    assert value == json.loads(text)
