"""Lies of a language model are refused, honest requests are admitted, in whatever words."""

from dataclasses import replace

import pytest

from embomatrix.factory.admission import RefusalReason, TaskRefusal
from embomatrix.factory.evaluate.lies import (
    GOAL_CALLS,
    GOAL_TOKENS,
    LieTable,
    ScriptedModel,
    ScriptedRequest,
    evaluate_lies,
    is_refused,
    outcomes_of,
    written_by,
)
from embomatrix.factory.social.model.agents import READING, SUMMARY
from embomatrix.factory.social.rules.demands import differences
from embomatrix.factory.social.rules.faults import FaultKind
from embomatrix.factory.social.scene_kinds import SceneKinds
from embomatrix.llm.ledger import Ledger
from embomatrix.llm.values import ChatRequest, Reply, UnusableReplyError

TABLE = LieTable.load()
LIES = {lie.name: lie for lie in TABLE.lies}
HONEST = {each.name: each for each in TABLE.honest}


@pytest.fixture(scope="module")
def scene() -> SceneKinds:
    return TABLE.kinds()


def test_all_lies_are_refused_and_all_honest_requests_admitted_at_half_the_cost() -> None:
    found = evaluate_lies()
    assert found.figure("lies_refused").value == 1.0
    assert found.figure("lies_refused").n >= 20
    assert found.figure("honest_admitted").value == 1.0
    assert found.figure("honest_admitted").n >= 5
    assert 1.0 < found.figure("calls_per_task").value <= GOAL_CALLS
    assert 500 < found.figure("tokens_per_task").value <= GOAL_TOKENS


def test_failure_of_the_writer_is_no_refusal_of_a_lie(scene: SceneKinds) -> None:
    unfaithful = TaskRefusal(RefusalReason.UNFAITHFUL, "another place")
    unusable = TaskRefusal(RefusalReason.UNUSABLE_ANSWER, "no JSON")
    assert is_refused([unfaithful])
    assert is_refused([unusable, unfaithful])
    assert not is_refused([unusable])
    assert not is_refused([])
    assert not is_refused(outcomes_of(_Mute(TABLE.people, [LIES["polarity"]]), scene))


class _Mute(ScriptedModel):
    """Model that gives no summary of a dialogue."""

    async def complete(self, request: ChatRequest) -> Reply:
        if request.purpose == SUMMARY:
            raise UnusableReplyError("no summary")
        return await super().complete(request)


def test_lies_without_a_verdict_are_named_beside_the_refused_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    table = replace(TABLE, lies=(LIES["polarity"],))
    monkeypatch.setattr(LieTable, "load", lambda: table)
    monkeypatch.setattr("embomatrix.factory.evaluate.lies.ScriptedModel", _Mute)
    found = evaluate_lies()
    assert found.figure("lies_refused").value == 0.0
    assert found.notes == ("Lies without a verdict, since the writer got no usable answer: polarity.",)


@pytest.mark.parametrize("name", LIES)
def test_lie_breaks_the_rule_of_the_table(name: str, scene: SceneKinds) -> None:
    lie = LIES[name]
    found = [fault.kind.value for fault in TABLE.faults(lie, scene)]
    if lie.expected == FaultKind.OTHER_DEMANDS:
        assert not found
        assert lie.demands is not None
        assert differences(lie.demands, lie.wish, scene)
    else:
        assert lie.expected in found


def test_table_has_a_lie_for_every_rule() -> None:
    assert {lie.expected for lie in TABLE.lies} == set(FaultKind)


@pytest.mark.parametrize("name", HONEST)
def test_honest_request_breaks_no_rule_and_its_reading_equals_its_goal(name: str, scene: SceneKinds) -> None:
    request = HONEST[name]
    assert TABLE.faults(request, scene) == ()
    assert request.demands is not None
    assert differences(request.demands, request.wish, scene) == ()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        (
            "book",
            "Could you take the hardback from the bed and put it on the coffee table? Maya wants to read.",
        ),
        ("book", "Maya is looking for her book. It's on the bed, and she would like it on the coffee table."),
        ("book", "Since Maya will read after dinner, move the book lying on the bed to the coffee table."),
        ("oven", "Turn the oven off and open it so that it cools down faster."),
        ("oven", "Jonas has finished baking: please make sure the oven is off and its door is open."),
        ("teacups", "Please clear both teacups away from the coffee table into the kitchen sink."),
        (
            "teacups",
            "The two teacups on the coffee table belong in the sink in the kitchen; could you put them there?",
        ),
        ("magazines", "Ella's friends are coming, so clear all three magazines off the sofa."),
        ("magazines", "Please take the three magazines off the sofa, Ella needs room to sit."),
        ("laptop", "Maya has gone to bed: shut her laptop, the one on the bed."),
        ("plate", "Wash up the stained plate on the countertop in the kitchen, please."),
        (
            "fruit",
            "Put the banana from the countertop in the fridge and let it freeze until it is frozen solid.",
        ),
        (
            "lamp",
            "Switch the floor lamp on and lay the newspaper from the sofa beside the laptop on the bed.",
        ),
        ("bowls", "Bring exactly two of the bowls on the kitchen countertop to the coffee table for Jonas."),
        ("apple", "Maya fancies an apple: take one from the fridge and leave it on the bed."),
        ("book", "Would you mind carrying the hardback that Maya left on the bed over to the coffee table?"),
        (
            "book",
            "Maya's hardback is lying on the bed. She'd like it on the coffee table before she sits down, please.",
        ),
        ("oven", "Jonas left the oven on. Turn it off and open the oven door."),
        ("oven", "Please turn off the oven, then leave it open to cool."),
        (
            "supper",
            "Warm up the chicken leg from the fridge in the microwave; then set it on the plate on the kitchen countertop.",
        ),
        ("teacups", "Put all the teacups that stand on the coffee table into the sink in the kitchen."),
        ("apple", "Could you get an apple out of the fridge and put it on the bed for Maya?"),
        (
            "bowls",
            "Jonas wants to serve soup: put exactly two of the bowls from the countertop in the kitchen on the coffee table.",
        ),
        ("magazines", "Remove all magazines from the sofa so that Ella can sit down."),
        ("magazines", "There should be no magazines left on the sofa when Ella's friends arrive."),
        ("laptop", "Maya's laptop is lying open on the bed. Close it, please."),
        ("plate", "The plate on the countertop in the kitchen is stained. Could you clean it?"),
        ("fruit", "Please freeze the banana that lies on the countertop using the fridge."),
        (
            "lamp",
            "Turn on the floor lamp in the living room. The newspaper on the sofa should lie next to the laptop on the bed.",
        ),
        ("radio", "Take the radio from the kitchen countertop and set it on the sofa or the bed."),
    ],
)
def test_other_words_for_the_same_goal_break_no_rule(name: str, words: str, scene: SceneKinds) -> None:
    request = HONEST[name]
    again = ScriptedRequest(name, "", words, request.wish, None)
    assert [str(fault) for fault in TABLE.faults(again, scene)] == []


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("book", "Take Maya's hardback off the coffee table and put it back on the bed."),
        (
            "book",
            "Could somebody find out where the hardback on the bed came from? It looks nice near the coffee table.",
        ),
        (
            "book",
            "Maya wants her book on the bed to be moved to the coffee table, and the coffee table moved to the kitchen.",
        ),
        ("book", "Put the book from the bed on the coffee table, then open the window."),
        ("book", "Put the book from the bed on the coffee table and heat the soup."),
        ("book", "Put both books from the bed on the coffee table."),
        ("book", "Put the books from the bed on the coffee table."),
        ("book", "Put the book from the sofa on the coffee table."),
        ("oven", "Close the oven and switch it off."),
        ("oven", "Switch off the oven but keep it closed."),
        ("oven", "Leave the oven running and open its door."),
        (
            "supper",
            "Please put the chicken leg from the fridge on the plate on the countertop in the kitchen.",
        ),
        (
            "supper",
            "Freeze the chicken leg from the fridge and put it on the plate on the countertop in the kitchen.",
        ),
        ("teacups", "Ella wants both teacups from the coffee table put under the sink in the kitchen."),
        ("teacups", "Ella wants both teacups from the coffee table washed in the sink in the kitchen."),
        ("apple", "Please bring Maya two of the apples in the fridge and place them on the bed."),
        ("bowls", "Jonas needs all bowls from the countertop in the kitchen on the coffee table."),
        ("bowls", "Jonas needs at least two bowls from the countertop in the kitchen on the coffee table."),
        ("magazines", "All three magazines should stay on the sofa, please."),
        ("radio", "Jonas would like the radio from the countertop in the kitchen on the sofa."),
        (
            "radio",
            "Jonas would like the radio from the countertop in the kitchen on the sofa and on the bed.",
        ),
        ("laptop", "The laptop on the bed is closed; please open it for Maya."),
        ("laptop", "The laptop on the breakfast table is still open; please close it for Maya."),
        ("laptop", "Please switch off the laptop on the bed and close it for Maya."),
        ("plate", "Please break the stained plate on the countertop in the kitchen."),
        ("fruit", "Ella would love cold fruit: put the banana from the countertop in the fridge."),
        ("fruit", "Ella would love cold fruit: freeze the apple from the countertop in the fridge."),
        (
            "lamp",
            "It gets dark, so turn the table lamp in the living room on, and put the newspaper next to the laptop on the bed.",
        ),
        (
            "lamp",
            "It gets dark, so turn the floor lamp in the living room on, and put the laptop next to the newspaper on the bed.",
        ),
        (
            "lamp",
            "It gets dark, so turn the floor lamp in the living room on, and put the newspaper on the laptop on the bed.",
        ),
    ],
)
def test_words_for_another_goal_break_a_rule(name: str, words: str, scene: SceneKinds) -> None:
    request = HONEST[name]
    again = ScriptedRequest(name, "", words, request.wish, None)
    assert TABLE.faults(again, scene)


class _Penitent(ScriptedModel):
    """Model that tells a lie first and the honest request after the objection."""

    def __init__(self, lie: ScriptedRequest, honest: ScriptedRequest) -> None:
        super().__init__(TABLE.people, [lie])
        self._honest = honest

    async def complete(self, request: ChatRequest) -> Reply:
        if request.purpose == SUMMARY and len(request.messages) > 2:
            self.requests = [self._honest]
        return await super().complete(request)


@pytest.mark.parametrize("lie", ["polarity", "crossed places"])
def test_refused_request_is_corrected_once_with_the_fault_in_words(lie: str, scene: SceneKinds) -> None:
    model = _Penitent(LIES[lie], HONEST["oven"])
    ledger = Ledger(model)
    found = written_by(ledger, scene)
    assert [each.instruction for each in found] == [HONEST["oven"].instruction]
    assert ledger.accounts[SUMMARY].calls == 2
    objection = next(each for each in model.prompts if each.purpose == SUMMARY and len(each.messages) > 2)
    assert LIES[lie].instruction in objection.messages[-1].text
    assert ledger.accounts[READING].calls == 1 + (LIES[lie].expected == FaultKind.OTHER_DEMANDS)
