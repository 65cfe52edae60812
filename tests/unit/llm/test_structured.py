"""Typed answers are found in any text, and problems are reported to the model."""

import json
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, Field
from tests.fakes.chat_server import ChatServer

from embomatrix.llm.endpoint import Endpoint
from embomatrix.llm.structured import ask, read_json
from embomatrix.llm.values import ChatRequest, Message, Speaker, UnusableReplyError


class Person(BaseModel):
    name: str = Field(min_length=1)
    age: int = Field(ge=0)


ANN = '{"name": "Ann", "age": 41}'
QUESTION = ChatRequest("cast", (Message(Speaker.USER, "Who?"),), max_tokens=50)


async def asked(*script, **options):
    server = ChatServer(*script)
    with server.serving() as url:
        async with Endpoint(url, "small-1") as endpoint:
            try:
                return await ask(endpoint, QUESTION, Person, **options), server
            except UnusableReplyError as error:
                return error, server


@pytest.mark.parametrize(
    "text",
    [
        ANN,
        f"Sure! Here it is:\n```json\n{ANN}\n```\nAnything else?",
        f'<think>maybe {{"name": "Bo", "age": 3}}?</think>{ANN}',
        f"The list [1, 2] is not it, {ANN} is.",
        f'```\n{ANN}\n```\nnot {{"name": "Bo", "age": 3}}',
    ],
)
def test_value_is_found_anywhere_in_the_text(text):
    assert read_json(text, Person) == Person(name="Ann", age=41)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("I can't do that.", "it holds no complete JSON value"),
        ('{"name": "Ann", "ag', "it holds no complete JSON value"),
        (
            '{"name": "", "age": -1}',
            "name: string should have at least 1 character; age: input should be greater",
        ),
        ("[1, 2]", "the value: input should be"),
        ("[" * 100_000, "it holds no complete JSON value"),
        (r'{"name": "Ann \ud83d", "age": 3}', "it contains half of a surrogate pair"),
    ],
)
def test_problems_are_reported_by_field(text, sentence):
    with pytest.raises(ValueError, match=sentence):
        read_json(text, Person)


@pytest.mark.parametrize("text", ["```" + "\n" * 300_000, "```\n" * 50_000 + "```" + " " * 300_000])
def test_fences_that_never_close_are_read_in_linear_time(text):
    began_s = time.process_time()
    with pytest.raises(ValueError, match="no complete JSON value"):
        read_json(text, Person)
    assert time.process_time() - began_s < 5.0


@given(st.text())
def test_text_without_a_value_raises_a_sentence(text):
    with pytest.raises(ValueError, match=r"\w"):
        read_json(text, Person)


@given(
    st.text(alphabet=st.characters(exclude_characters="{[`<")),
    st.builds(Person, name=st.text(min_size=1), age=st.integers(0)),
)
def test_prose_before_and_after_changes_nothing(prose, person):
    assert read_json(prose + person.model_dump_json() + prose, Person) == person


async def test_error_is_quoted_and_corrected_answer_accepted():
    answer, server = await asked("Ann!", '{"name": "Ann"}', ANN)
    assert answer == Person(name="Ann", age=41)
    assert len(server.requests) == 3
    last = server.requests[-1]["messages"]
    assert [turn["role"] for turn in last] == ["user", "assistant", "user", "assistant", "user"]
    assert "age: field required" in last[-1]["content"]


async def test_error_of_a_check_is_quoted_too():
    def grown_up(person):
        if person.age < 18:
            raise ValueError(f"{person.name} is {person.age}: expected a grown-up")

    answer, server = await asked('{"name": "Bo", "age": 3}', ANN, check=grown_up)
    assert answer.name == "Ann"
    assert "Bo is 3: expected a grown-up" in server.requests[-1]["messages"][-1]["content"]


async def test_unusable_model_is_reported_after_its_answers():
    error, server = await asked("no", "nein", "non")
    assert "cast: 3 answers of scripted-1, none usable" in str(error)
    assert len(server.requests) == 3


async def test_cut_off_answer_is_reported_as_such():
    cut = (
        200,
        {},
        json.dumps({"choices": [{"message": {"content": '{"name'}, "finish_reason": "length"}]}),
        0.0,
    )
    error, _ = await asked(cut)
    assert "cut off after 50 tokens" in str(error)
