"""Model writer: dialogues of several agents, bounded failures, and scenes laid out for their requests."""

import asyncio
import json
from collections.abc import Sequence

import numpy as np
import pytest
from tests.fakes.chat_server import ChatServer

from embomatrix.factory.admission import RefusalReason, TaskRefusal
from embomatrix.factory.commands.app import _print_account
from embomatrix.factory.days.laying import LaidOut, lay_out
from embomatrix.factory.days.model_days import ModelDays, planned_task, with_tools
from embomatrix.factory.days.planning import PlannedDay
from embomatrix.factory.evaluate.lies import LieTable, ScriptedModel, ScriptedRequest
from embomatrix.factory.pipeline.variants import VariantOrder
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.model.agents import DAY, PEOPLE, SIGHT, SUMMARY, TURN, SocialModelAgents
from embomatrix.factory.social.model.writer import ModelWriter
from embomatrix.factory.social.scene_kinds import kinds_of
from embomatrix.factory.social.wish import Condition, Wish, WishedObjects, WishPredicate
from embomatrix.factory.social.written import WrittenRequest
from embomatrix.factory.writer.variant import build_variant
from embomatrix.llm.endpoint import Endpoint, EndpointLimits
from embomatrix.llm.ledger import Ledger
from embomatrix.llm.values import ChatRequest, EndpointError, Reply, UnusableReplyError, Usage
from embomatrix.world.state import Relation
from embomatrix.world.task import TaskCategory

TABLE = LieTable.load()
BASE = build_base_scene(TABLE.scene, seed=0)
SCENE = kinds_of(SceneView(BASE))
HONEST = {each.name: each for each in TABLE.honest}


def scripted(*names: str) -> ScriptedModel:
    return ScriptedModel(TABLE.people, [HONEST[name] for name in names])


def written(
    model: ScriptedModel, count: int = 1, earlier: Sequence[str] = ()
) -> list[WrittenRequest | TaskRefusal]:
    with ModelWriter(SocialModelAgents(model)) as writer:
        return writer.write(SCENE, count, 3, earlier)


def prompts(model: ScriptedModel, purpose: str) -> list[str]:
    return [
        "\n".join(message.text for message in each.messages)
        for each in model.prompts
        if each.purpose == purpose
    ]


def test_one_dialogue_gives_several_requests_with_their_conversation() -> None:
    model = scripted("book", "oven")
    found = written(model, 2)
    assert [each.instruction for each in found if isinstance(each, WrittenRequest)] == [
        HONEST["book"].instruction,
        HONEST["oven"].instruction,
    ]
    first = found[0]
    assert isinstance(first, WrittenRequest)
    assert first.wish == HONEST["book"].wish
    assert [turn.speaker for turn in first.conversation.turns] == [
        "Maya",
        "robot",
        "Maya",
        "robot",
        "Jonas",
        "robot",
    ]
    assert first.signature == "ontop(hardback,coffee_table)"
    assert "**Jonas** (answer)" in first.transcript()


def test_each_turn_is_one_call_with_the_knowledge_of_its_speaker_alone() -> None:
    model = scripted("book", "oven")
    written(model, 2)
    maya, robot, again, _, jonas, last = prompts(model, TURN)
    event = "A thing that was left on the bed is needed"
    other = "Something from the fridge would be good"
    assert event in maya
    assert other not in maya
    assert other in jonas
    assert event not in jonas
    assert event in again
    assert "reads on the sofa before bed" in maya
    assert "You are Ella's father." in jonas
    assert "bakes on Sundays" in jonas
    for heard in (robot, last):
        assert event not in heard
        assert other not in heard
        assert "Habit" not in heard
        assert "wall cabinet" in heard
    assert HONEST["book"].instruction in robot


def test_no_prompt_names_an_object_of_the_scene() -> None:
    model = scripted("book")
    written(model)
    names = [item.name for item in BASE.objects]
    for prompt in (text for purpose in (PEOPLE, DAY, TURN, SUMMARY) for text in prompts(model, purpose)):
        assert not [name for name in names if name in prompt]


def test_day_planner_sees_earlier_tasks_and_those_just_written() -> None:
    model = scripted("book")
    written(model, 5, ["Jonas wants the window open."])
    first, second, *_ = prompts(model, DAY)
    assert "- Jonas wants the window open." in first
    assert HONEST["book"].instruction not in first
    assert f"- {HONEST['book'].instruction}" in second


def test_people_are_invented_once_for_each_home() -> None:
    model = scripted("book")
    with ModelWriter(SocialModelAgents(model)) as writer:
        writer.write(SCENE, 2, 0)
        writer.write(SCENE, 2, 1)
    assert len(prompts(model, PEOPLE)) == 1


def test_equal_seeds_give_equal_questions_and_requests() -> None:
    first, second = scripted("book", "oven"), scripted("book", "oven")
    assert written(first, 4) == written(second, 4)
    assert first.prompts == second.prompts
    seeds = [each.seed for each in first.prompts]
    assert len(set(seeds)) > len(seeds) // 2


class _Slow(ScriptedModel):
    """Model that answers turns slowly, and counts those in progress."""

    now = 0
    most = 0

    async def complete(self, request: ChatRequest) -> Reply:
        self.now += 1
        self.most = max(self.most, self.now)
        await asyncio.sleep(0.01)
        self.now -= 1
        return await super().complete(request)


def test_dialogues_are_held_concurrently() -> None:
    model = _Slow(TABLE.people, [HONEST["book"]])
    written(model, 4)
    assert model.most == 2  # the scripted day has two events


class _Garbage:
    """Model that writes no JSON for these purposes, or for any."""

    def __init__(self, model: ScriptedModel, *purposes: str) -> None:
        self._model = model
        self._purposes = purposes
        self.calls = 0

    async def complete(self, request: ChatRequest) -> Reply:
        self.calls += 1
        if not self._purposes or request.purpose in self._purposes:
            return Reply("Sure! Here is what you want.", "garbage-1", Usage(), "stop", 0.0)
        return await self._model.complete(request)


@pytest.mark.parametrize(("purposes", "most"), [((), 9), ((TURN,), 12), ((SUMMARY,), 40)])
def test_garbage_ends_the_writing_after_a_bounded_number_of_calls(
    purposes: tuple[str, ...], most: int
) -> None:
    model = _Garbage(scripted("book"), *purposes)
    with (
        ModelWriter(SocialModelAgents(model)) as writer,
        pytest.raises(
            UnusableReplyError, match="none usable, the last because it holds no complete JSON value"
        ),
    ):
        writer.write(SCENE, 100, 0)
    assert model.calls <= most


def test_lies_without_end_are_refused_a_bounded_number_of_times() -> None:
    lie = next(each for each in TABLE.lies if each.name == "polarity")
    found = written(ScriptedModel(TABLE.people, [lie]), 2)
    assert len(found) == 6
    reasons = {each.reason if isinstance(each, TaskRefusal) else "" for each in found}
    assert reasons == {RefusalReason.UNFAITHFUL}


class _Unreachable(ScriptedModel):
    """Model that can't be reached when it is asked to correct a request."""

    async def complete(self, request: ChatRequest) -> Reply:
        if request.purpose == SUMMARY and len(request.messages) > 2:
            raise EndpointError("no answer to the objection")
        return await super().complete(request)


def test_good_requests_stay_when_the_correction_of_others_fails() -> None:
    lie = next(each for each in TABLE.lies if each.name == "polarity")
    found = written(_Unreachable(TABLE.people, [HONEST["book"], lie]))
    assert [each.instruction for each in found if isinstance(each, WrittenRequest)] == [
        HONEST["book"].instruction
    ]
    assert [each.reason for each in found if isinstance(each, TaskRefusal)] == [
        RefusalReason.UNFAITHFUL,
        RefusalReason.NO_ANSWER,
    ]


def test_dead_endpoint_ends_the_writing() -> None:
    server = ChatServer((500, {}, "broken", 0.0))
    limits = EndpointLimits(attempts=2, first_wait_s=0.01, timeout_s=5.0)
    with (
        server.serving() as url,
        ModelWriter(SocialModelAgents(Endpoint(url, "small-1", limits=limits))) as writer,
        pytest.raises(EndpointError, match=r"role-playing agent: the endpoint .* answered 500"),
    ):
        writer.write(SCENE, 10, 0)
    assert len(server.requests) == 6


def test_schema_of_the_answer_is_on_the_wire_and_in_no_prompt() -> None:
    server = ChatServer(json.dumps(TABLE.people), "no")
    with (
        server.serving() as url,
        ModelWriter(SocialModelAgents(Endpoint(url, "small-1"))) as writer,
        pytest.raises(UnusableReplyError),
    ):
        writer.write(SCENE, 10, 0)
    for sent, name in zip(server.requests[:2], ("PeopleAnswer", "DayAnswer"), strict=True):
        assert sent["response_format"]["json_schema"]["schema"]["title"] == name
        assert not any('"properties"' in message["content"] for message in sent["messages"])


class _Evasive(ScriptedModel):
    """Model whose robot never confirms."""

    async def complete(self, request: ChatRequest) -> Reply:
        reply = await super().complete(request)
        return Reply(reply.text.replace("confirm", "propose"), reply.model, reply.usage, "stop", 0.0)


def test_dialogue_without_confirmation_leads_to_no_request() -> None:
    model = _Evasive(TABLE.people, [HONEST["book"]])
    with (
        ModelWriter(SocialModelAgents(model)) as writer,
        pytest.raises(UnusableReplyError, match="the robot confirmed nothing in 8 turns"),
    ):
        writer.write(SCENE, 1, 0)
    assert not prompts(model, SUMMARY)


class _Seeing(ScriptedModel):
    """Vision model: a sentence for each room that the pictures show."""

    async def complete(self, request: ChatRequest) -> Reply:
        if request.purpose == SIGHT:
            assert request.messages[1].images == (b"png of Rs_int",)
            rooms = {room: f"A bright {room} with a low table." for room in SCENE.rooms}
            return Reply(json.dumps({"rooms": rooms}), "seeing", Usage(), "stop", 0.0)
        return await super().complete(request)


def test_vision_model_describes_the_rooms_to_the_other_agents() -> None:
    model = _Seeing(TABLE.people, [HONEST["book"]])
    with ModelWriter(SocialModelAgents(model), look=lambda base: (f"png of {base}".encode(),)) as writer:
        writer.write(SCENE, 1, 0)
    assert all(
        "A bright kitchen_0 with a low table." in text
        for text in prompts(model, PEOPLE) + prompts(model, DAY)
    )


def test_everyday_names_of_kinds_and_rooms_are_understood() -> None:
    book = HONEST["book"]
    groups = [
        group.model_copy(update={"room": group.room.replace("bedroom_0", "the bedroom"), "kind": kind})
        for group, kind in zip(book.wish.objects, ("bed", "hardback book", "coffee table"), strict=True)
    ]
    told = ScriptedRequest(
        "book",
        "",
        book.instruction,
        Wish(objects=tuple(groups), conditions=book.wish.conditions),
        book.demands,
    )
    found = written(ScriptedModel(TABLE.people, [told]))[0]
    assert isinstance(found, WrittenRequest)
    assert found.wish == book.wish


# Drafts about a variant

VARIANT = build_variant(
    BASE, tuple(room.name for room in BASE.rooms), "Rs_int-model", np.random.default_rng(5)
)
VIEW = SceneView(VARIANT.scene)


def planned(*requests: ScriptedRequest) -> PlannedDay | TaskRefusal:
    rooms = tuple(room.name for room in BASE.rooms)
    order = VariantOrder("train", 0, BASE.base, rooms, dict.fromkeys(TaskCategory, 1), frozenset())
    with ModelWriter(SocialModelAgents(ScriptedModel(TABLE.people, list(requests)))) as writer:
        return ModelDays(writer).plan(order, BASE, 0)


def test_day_of_a_model_knows_the_earlier_tasks_of_its_own_home_in_their_order() -> None:
    rooms = tuple(room.name for room in BASE.rooms)
    order = VariantOrder(
        "train",
        1,
        BASE.base,
        rooms,
        dict.fromkeys(TaskCategory, 1),
        frozenset({"inside(egg,bowl)|Put the egg in the bowl of another home."}),
        told=("Please tidy up.", "Fetch an apple."),
    )
    model = scripted("book")
    with ModelWriter(SocialModelAgents(model)) as writer:
        ModelDays(writer).plan(order, BASE, 0)
    day = prompts(model, DAY)[0]
    assert "- Please tidy up.\n- Fetch an apple." in day
    assert "another home" not in day


def wish_for(kind: str, count: int = 1) -> Wish:
    bed = WishedObjects(label="bed", kind="bed", room="bedroom_0", furniture=True)
    table = WishedObjects(label="table", kind="coffee_table", room="living_room_0", furniture=True)
    thing = WishedObjects(
        label="thing", kind=kind, count=count, room="living_room_0", relation=Relation.ONTOP, host="table"
    )
    return Wish(
        objects=(bed, table, thing),
        conditions=(Condition(predicate=WishPredicate.ONTOP, things="thing", place="bed"),),
    )


def test_a_thing_that_the_scene_lacks_is_laid_out_for_the_models_request() -> None:
    words = "Please put the violin from the coffee table on the bed."
    day = planned(ScriptedRequest("violin", "", words, wish_for("violin"), None))
    assert isinstance(day, PlannedDay), day
    (task,) = day.tasks
    assert task.draft.task.goal_bddl == "(ontop violin_1 bed_1)"
    assert task.draft.task.category is TaskCategory.PICK_AND_PLACE
    assert {"violin_1", "bed_1"} <= set(task.draft.task.table)
    assert task.draft.task.instruction == words
    assert words in task.draft.transcript
    assert day.scene.by_name["violin_1"].host.startswith("coffee_table")


@pytest.mark.parametrize("kind", ["bottom_cabinet", "top_cabinet"])
@pytest.mark.parametrize("seed", range(3))
def test_a_wall_cabinet_is_no_low_cabinet_though_both_have_one_type(kind: str, seed: int) -> None:
    cabinet = WishedObjects(label="cabinet", kind=kind, room="kitchen_0", furniture=True)
    wish = Wish(objects=(cabinet,), conditions=(Condition(predicate=WishPredicate.OPEN, things="cabinet"),))
    laid = lay_out("cabinet", [wish], BASE, np.random.default_rng(seed), exact=True)
    assert isinstance(laid, LaidOut), laid
    assert SceneView(laid.scene).category(laid.members[0]["cabinet"][0]) == kind


def test_wishes_get_the_tool_that_nobody_mentions() -> None:
    counter = WishedObjects(label="counter", kind="countertop", room="kitchen_0", furniture=True)
    apple = WishedObjects(label="apple", kind="apple", relation=Relation.ONTOP, host="counter")
    knife = WishedObjects(label="knife", kind="carving_knife", relation=Relation.ONTOP, host="counter")
    slices = (Condition(predicate=WishPredicate.SLICED, things="apple"),)
    tool = with_tools(Wish(objects=(counter, apple), conditions=slices)).objects[-1]
    assert (tool.kind, tool.room) == ("carving_knife", "kitchen_0")
    own = Wish(objects=(counter, apple, knife), conditions=slices)
    assert with_tools(own) == own
    clean = (Condition(predicate=WishPredicate.STAINED, things="counter", holds=False),)
    assert with_tools(Wish(objects=(counter,), conditions=clean)).objects[-1].kind == "rag"


def test_a_person_with_nothing_to_add_says_thanks() -> None:
    model = _Satisfied(TABLE.people, [HONEST["book"]])
    first = written(model)[0]
    assert isinstance(first, WrittenRequest)
    assert [turn.act.value for turn in first.conversation.turns][-1] == "thanks"
    assert {turn.speaker for turn in first.conversation.turns} == {"Maya", "robot", "Jonas"}


class _Satisfied(ScriptedModel):
    """Robot that confirms at once, and people who thank it when they are heard."""

    def _turn(self, request: ChatRequest) -> object:
        told = " ".join(each.instruction for each in self.requests)
        if "You are a household robot" in request.messages[0].text:
            return {"act": "confirm", "text": f"I will do this: {told}"}
        return (
            {"act": "need", "text": told}
            if "robot:" not in request.messages[1].text
            else {
                "act": "thanks",
                "text": "Thank you, that is all.",
            }
        )


def test_words_that_also_fit_another_object_of_the_scene_are_refused() -> None:
    laid = lay_out("two", [wish_for("violin", 2)], BASE, np.random.default_rng(0))
    assert isinstance(laid, LaidOut)
    first, second = laid.members[0]["thing"]
    request = next(each for each in written(scripted("book")) if isinstance(each, WrittenRequest))
    request = request.model_copy(
        update={"wish": wish_for("violin"), "instruction": "Put the violin on the bed."}
    )
    members = {**laid.members[0], "thing": (first,)}
    found = planned_task("t", SceneView(laid.scene), request, {**members, "other": (second,)})
    assert isinstance(found, TaskRefusal)
    assert found.reason is RefusalReason.UNFAITHFUL
    assert second in found.sentence


def test_build_summary_tells_calls_and_tokens_for_each_admitted_task(
    capsys: pytest.CaptureFixture[str],
) -> None:
    ledger = Ledger(scripted("book", "oven"))
    with ModelWriter(SocialModelAgents(ledger)) as writer:
        writer.write(SCENE, 2, 0)
    _print_account(ledger, 2)
    total = ledger.total()
    tokens = (total.prompt_tokens + total.completion_tokens) / 2
    assert (
        f"{total.calls / 2:.1f} calls and {tokens:,.0f} tokens for each admitted task"
        in capsys.readouterr().out
    )


def test_scene_description_is_short_and_counts_alike_furniture() -> None:
    text = SCENE.listed()
    assert '5 x top_cabinet "wall cabinet"' in text
    assert '2 x pot_plant "potted plant" on coffee_table' in text
    assert len(text) < 1000
    assert "5 x wall cabinet" in SCENE.told()
