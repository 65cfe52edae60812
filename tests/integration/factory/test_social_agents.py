"""Each social agent runs alone; its answer is the input of the next agent."""

import json

import pytest
from tests.fakes.chat_server import ChatServer
from typer.testing import CliRunner

from embomatrix.factory.commands.agents import ALL_AGENTS
from embomatrix.factory.commands.app import app
from embomatrix.factory.days.agent_interfaces import SOCIAL_AGENTS, SocialAgent
from embomatrix.factory.evaluate.lies import LieTable
from embomatrix.factory.layout.agent_interfaces import AgentName
from embomatrix.factory.social.values import SummaryBrief, TalkBrief

BRIEF = '{"scene": "Rs_int", "seed": 1}'


def run(name: str, brief: str, *more: str) -> str:
    answer = CliRunner().invoke(app, ["agent", name, "--in", "-", *more], input=brief)
    assert answer.exit_code == 0, answer.output
    return answer.stdout


def test_agent_names_are_unique() -> None:
    assert set(ALL_AGENTS) == {*SocialAgent, *AgentName}
    assert len(ALL_AGENTS) == len(SocialAgent) + len(AgentName)


def test_agents_chain_from_scene_to_instruction() -> None:
    people = run("role-player", BRIEF)
    talk = run("social-simulator", people)
    summary_brief = SOCIAL_AGENTS[SocialAgent.SUMMARIZER].read(talk)
    assert isinstance(summary_brief, SummaryBrief)
    assert summary_brief.cast == SOCIAL_AGENTS[SocialAgent.SIMULATOR].read(people).cast
    summary = json.loads(run("summarizer", talk))
    assert summary["wishes"] == [*summary_brief.conversation.last_wishes]
    assert any(name in summary["instruction"] for name in summary_brief.cast.names)
    assert run("social-simulator", people) == talk


def test_scene_facts_list_the_rooms() -> None:
    facts = json.loads(run("scene-extractor", BRIEF))
    assert facts["base"] == "Rs_int"
    assert {room["name"] for room in facts["rooms"]} >= {"kitchen_0", "living_room_0"}


def test_language_model_plays_the_people_on_request() -> None:
    cast = SOCIAL_AGENTS[SocialAgent.SIMULATOR].read(run("role-player", BRIEF)).cast
    told = [
        # A model says what the others are to a person; a person's ties are what the person is to the others.
        {**each.model_dump(), "ties": {o.name: o.ties[each.name] for o in cast.people if each.name in o.ties}}
        for each in cast.people
    ]
    people = {"setting": cast.setting, "people": told}
    events = [{**slot.model_dump(), "needs": ["The cup should be on the table."]} for slot in cast.day[:3]]
    with ChatServer("no", json.dumps(people), json.dumps({"events": events})).serving() as url:
        found = run("role-player", BRIEF, "--llm", url, "--model", "small-1")
    planned = cast.model_copy(update={"day": cast.day[:3]})
    assert SOCIAL_AGENTS[SocialAgent.SIMULATOR].read(found) == TalkBrief(scene="Rs_int", cast=planned, seed=1)


def test_language_models_hold_a_dialogue_and_summarise_it() -> None:
    cast = SOCIAL_AGENTS[SocialAgent.SIMULATOR].read(run("role-player", BRIEF)).cast
    events = [{**slot.model_dump(), "needs": ["The book should be on the sofa."]} for slot in cast.day[:2]]
    need, confirm = {"act": "need", "text": "My book."}, {"act": "confirm", "text": "I will bring it."}
    clarify, answer = {"act": "clarify", "text": "Where to?"}, {"act": "answer", "text": "The sofa."}
    turns = [json.dumps(turn) for turn in (need, clarify, answer, confirm)]
    brief = TalkBrief(scene="Rs_int", cast=cast, seed=1).model_dump_json()
    with ChatServer(json.dumps({"events": events}), *turns).serving() as url:
        talk = run("social-simulator", brief, "--llm", url, "--model", "small-1")
    summary_brief = SOCIAL_AGENTS[SocialAgent.SUMMARIZER].read(talk)
    assert [turn.text for turn in summary_brief.conversation.turns] == [
        "My book.", "Where to?", "The sofa.", "I will bring it.",
    ]  # fmt: skip
    honest = LieTable.load().honest[0].answer()
    with ChatServer(json.dumps({"requests": [honest]})).serving() as url:
        summary = json.loads(run("summarizer", talk, "--llm", url, "--model", "small-1"))
    assert summary["instruction"] == honest["instruction"]


@pytest.mark.parametrize(
    ("name", "brief", "sentence"),
    [
        ("role-playe", BRIEF, "there is no agent"),
        ("role-player", '{"seed": 1}', "scene: field required"),
        ("role-player", '{"scene": "Atlantis"}', "Atlantis"),
        ("social-simulator", BRIEF, "cast: field required"),
    ],
)
def test_invalid_brief_exits_with_one_sentence(name: str, brief: str, sentence: str) -> None:
    answer = CliRunner().invoke(app, ["agent", name, "--in", "-"], input=brief)
    assert answer.exit_code == 2
    assert sentence in " ".join(answer.output.split())
