"""Text becomes a plan or raises one PlanError with a reason from a closed set."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.skills.parse import (
    PlanError,
    PlanReason,
    last_json_plan,
    parse_answer,
    parse_plan,
    plan_from_json,
    plan_to_json,
    plan_to_lines,
)
from embomatrix.skills.syntax import (
    ALIASES,
    MAX_PLAN_BYTES,
    MAX_STEPS,
    PROFILES,
    SIGNATURES,
    Arg,
    PlaceRelation,
    Skill,
    SkillCall,
)
from embomatrix.world.task import Profile

HOUSEHOLD = Profile.HOUSEHOLD

TWO = (
    SkillCall(Skill.MOVE, object_index=3),
    SkillCall(Skill.PLACE, object_index=4, relation=PlaceRelation.INSIDE),
)
FLAT = '[{"action": "move", "object_index": 3}, {"action": "place", "object_index": 4, "relation": "inside"}]'
NESTED = (
    '{"action_sequence": [{"action": "move", "parameters": {"object_index": 3}},'
    ' {"action": "place", "parameters": {"object_index": 4, "relation": "inside"}}]}'
)


@pytest.mark.parametrize(
    "text",
    [
        FLAT,
        NESTED,
        NESTED.replace("action_sequence", "plan"),
        f"```json\n{FLAT}\n```",
        f"Sure! I would go there first.\n```\n{NESTED}\n```\nThat should do it [I hope].",
        f"<think>Maybe {FLAT.replace('3', '9')}? No.</think>\n{FLAT}",
        f"<think>\nmove 9; open 9\n</think>\n{FLAT}",
        f"First try: {FLAT.replace('3', '9')} but better: {FLAT}",
        f"The list [1, 2] and the set {{a}} are no plans.\n{FLAT}",
        FLAT.replace("move", "MOVE").replace("inside", "Inside"),
        FLAT.replace('"move",', '"move", "comment": "go there", "relation": "ontop",'),
        "move 3\nplace 4 inside",
        "move 3; place 4 inside",
        "Move 3;\n\nPLACE 4 INSIDE;",
        "1. move 3\n2) place 4 inside",
        "- move 3\n* place 4 inside\n",
        "Here is my plan:\n```\nmove 3\nplace 4 inside\n```\nThen the milk is where it should be.",
        "<think>open 2</think>move 3;place 4 inside",
        "Move to the cup and put it away, like this.\nmove 3\nplace 4 inside",
    ],
)
def test_both_plan_forms_are_found_in_model_output(text: str) -> None:
    assert parse_plan(text) == TWO


ERRORS: dict[str, PlanReason] = {
    "": PlanReason.NO_PLAN,
    "I can't do that.": PlanReason.NO_PLAN,
    "[]": PlanReason.NO_PLAN,
    '{"plan": []}': PlanReason.NO_PLAN,
    "null": PlanReason.NO_PLAN,
    FLAT[:-1]: PlanReason.NO_PLAN,
    FLAT.replace('"', "'"): PlanReason.NO_PLAN,
    "[" * 50_000: PlanReason.NO_PLAN,
    '[{"action": ' * 4_000: PlanReason.NO_PLAN,
    "<think>I wonder": PlanReason.NO_PLAN,
    "__import__('os').system('true')": PlanReason.NO_PLAN,
    "x" * (MAX_PLAN_BYTES + 1): PlanReason.TOO_LONG,
    "é" * (MAX_PLAN_BYTES // 2 + 1): PlanReason.TOO_LONG,
    "move 3\n" * (MAX_STEPS + 1): PlanReason.TOO_MANY_STEPS,
    json.dumps([{"action": "fly"}] * (MAX_STEPS + 1)): PlanReason.TOO_MANY_STEPS,
    '[{"action": "fly", "object_index": 3}]': PlanReason.UNKNOWN_SKILL,
    '[{"action": 7}]': PlanReason.UNKNOWN_SKILL,
    '[{"action": null}]': PlanReason.UNKNOWN_SKILL,
    "fly 3": PlanReason.UNKNOWN_SKILL,
    "move 3\nteleport 4": PlanReason.UNKNOWN_SKILL,
    '[{"action": "move"}]': PlanReason.MISSING_ARGUMENT,
    '[{"action": "move", "object_index": null}]': PlanReason.MISSING_ARGUMENT,
    '{"plan": [{"skill": "move"}]}': PlanReason.MISSING_ARGUMENT,
    '[{"action": "move", "object_index": 1}, 5]': PlanReason.MISSING_ARGUMENT,
    "place 3": PlanReason.MISSING_ARGUMENT,
    "pick_up": PlanReason.MISSING_ARGUMENT,
    '[{"action": "move", "object_index": "3"}]': PlanReason.WRONG_ARGUMENT,
    '[{"action": "move", "object_index": 3.5}]': PlanReason.WRONG_ARGUMENT,
    '[{"action": "move", "object_index": true}]': PlanReason.WRONG_ARGUMENT,
    '[{"action": "move", "object_index": [3]}]': PlanReason.WRONG_ARGUMENT,
    '[{"action": "move", "object_index": 99999999999999999999}]': PlanReason.WRONG_ARGUMENT,
    '[{"action": "move", "parameters": [3]}]': PlanReason.WRONG_ARGUMENT,
    '[{"action": "place", "object_index": 1, "relation": "above"}]': PlanReason.WRONG_ARGUMENT,
    '[{"action": "turn", "yaw": NaN}]': PlanReason.WRONG_ARGUMENT,
    '[{"action": "turn", "yaw": -Infinity}]': PlanReason.WRONG_ARGUMENT,
    '[{"action": "turn", "yaw": 1e999}]': PlanReason.WRONG_ARGUMENT,
    '[{"action": "turn", "yaw": 1' + "0" * 400 + "}]": PlanReason.WRONG_ARGUMENT,
    '[{"action": "go_to_room", "room_name": ""}]': PlanReason.WRONG_ARGUMENT,
    '[{"action": "go_to_room", "room_name": 4}]': PlanReason.WRONG_ARGUMENT,
    r'[{"action": "go_to_room", "room_name": "kitchen\ud83d"}]': PlanReason.WRONG_ARGUMENT,
    "go_to_room kitchen\ud83d": PlanReason.WRONG_ARGUMENT,
    "turn nan": PlanReason.WRONG_ARGUMENT,
    "turn inf": PlanReason.WRONG_ARGUMENT,
    "move 3 4": PlanReason.WRONG_ARGUMENT,
    "move cup": PlanReason.WRONG_ARGUMENT,
}


@pytest.mark.parametrize("text", ERRORS, ids=lambda text: text[:40])
def test_text_without_a_plan_has_one_reason_and_a_sentence(text: str) -> None:
    with pytest.raises(PlanError) as caught:
        parse_plan(text)
    assert caught.value.reason is ERRORS[text]
    assert 10 < len(str(caught.value)) < 400


def test_examples_cover_every_plan_error() -> None:
    assert set(ERRORS.values()) == set(PlanReason)


def test_impossible_index_parses_and_fails_at_execution() -> None:
    assert parse_plan("move -1") == (SkillCall(Skill.MOVE, object_index=-1),)
    assert parse_plan("move 1000000")[0].object_index == 1_000_000


def test_integers_are_accepted_as_angles() -> None:
    assert parse_plan('[{"action": "move_forward", "distance": 1, "yaw": -2}]') == (
        SkillCall(Skill.MOVE_FORWARD, distance=1.0, yaw=-2.0),
    )


def test_message_names_the_step_and_the_value_found() -> None:
    with pytest.raises(PlanError, match=r"step 2: object_index is 'cup': expected a whole number"):
        parse_plan('[{"action": "move", "object_index": 3}, {"action": "open", "object_index": "cup"}]')


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (" \n", "the text is empty"),
        ("I would rather not.", "the text begins with 'I would rather not.'"),
        ('[{"action": "move", "object_index": 3}', "its JSON is invalid at line 1, column 39: "),
        ('{"action": "move", "object_index": 3}', "its JSON contains no array of calls"),
        ("[" * 30_000, "its JSON can't be read"),
    ],
)
def test_message_describes_the_text_found_instead_of_a_plan(text: str, found: str) -> None:
    with pytest.raises(PlanError) as refusal:
        parse_plan(text)
    assert str(refusal.value).startswith(f"no plan was found ({found}")


def test_index_beyond_64_bits_is_named_as_such() -> None:
    with pytest.raises(PlanError, match="is a number beyond 64 bits"):
        parse_plan(f"move {10**30}")


numbers = st.floats(-100, 100)
ARGUMENTS: dict[Arg, st.SearchStrategy[Any]] = {
    Arg.OBJECT: st.integers(-5, 100),
    Arg.SOURCE: st.integers(-5, 100),
    Arg.RELATION: st.sampled_from(PlaceRelation),
    Arg.YAW: numbers,
    Arg.DISTANCE: numbers,
    Arg.ROOM: st.from_regex(r"[a-z_]{1,20}_[0-9]", fullmatch=True),
}


@st.composite
def calls(draw: st.DrawFn) -> SkillCall:
    skill = draw(st.sampled_from(Skill))
    return SkillCall(skill, **{arg.value: draw(ARGUMENTS[arg]) for arg in SIGNATURES[skill]})


plans = st.lists(calls(), min_size=1, max_size=12).map(tuple)


@given(plans)
def test_plan_is_equal_after_a_round_trip_in_both_forms(plan: tuple[SkillCall, ...]) -> None:
    assert parse_plan(plan_to_lines(plan), HOUSEHOLD) == plan
    assert parse_plan(json.dumps(plan_to_json(plan), indent=1), HOUSEHOLD) == plan
    assert plan_from_json(plan_to_json(plan), HOUSEHOLD) == plan


@given(plans)
def test_paper_profile_accepts_only_skills_of_the_paper(
    plan: tuple[SkillCall, ...],
) -> None:
    if {call.skill for call in plan} <= set(PROFILES[Profile.PAPER]):
        assert parse_plan(plan_to_lines(plan)) == plan
        return
    for text in (plan_to_lines(plan), json.dumps(plan_to_json(plan))):
        with pytest.raises(PlanError) as caught:
            parse_plan(text)
        assert caught.value.reason is PlanReason.UNKNOWN_SKILL


def test_paper_profile_has_13_skills_and_household_3_more() -> None:
    assert set(PROFILES) == set(Profile)
    assert len(PROFILES[Profile.PAPER]) == 13
    assert PROFILES[Profile.HOUSEHOLD] == tuple(Skill)
    assert PROFILES[Profile.HOUSEHOLD][:13] == PROFILES[Profile.PAPER]


def test_tool_index_is_an_alias_of_source_index() -> None:
    text = '[{"action": "slice_object_with_tool", "object_index": 3, "tool_index": 5}]'
    assert parse_plan(text, HOUSEHOLD) == (SkillCall(Skill.SLICE, object_index=3, source_index=5),)
    assert set(ALIASES.values()) <= set(Arg)


@given(
    plans, st.text(max_size=60).filter(lambda text: "<" not in text and "[" not in text and "{" not in text)
)
def test_plan_is_found_after_any_prose(plan: tuple[SkillCall, ...], prose: str) -> None:
    assert parse_plan(f"{prose}\n```json\n{json.dumps(plan_to_json(plan))}\n```", HOUSEHOLD) == plan


@given(st.text(max_size=300))
def test_random_text_raises_only_plan_errors(text: str) -> None:
    refuse_or_read(text)


@given(plans, st.data())
def test_damaged_plan_raises_only_plan_errors(plan: tuple[SkillCall, ...], data: st.DataObject) -> None:
    for text in (json.dumps(plan_to_json(plan)), plan_to_lines(plan)):
        position = data.draw(st.integers(0, len(text)))
        end = data.draw(st.integers(position, len(text)))
        refuse_or_read(text[:position] + data.draw(st.text(max_size=8)) + text[end:])


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(["move", "place", "x"]),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["action", "parameters", "object_index", "plan"]), inner, max_size=4
        )
    ),
    max_leaves=12,
)


@given(json_values)
def test_any_json_value_is_read_or_raises_a_plan_error(value: Any) -> None:
    try:
        plan = plan_from_json(value)
    except PlanError:
        return
    assert plan


def refuse_or_read(text: str) -> None:
    try:
        plan = parse_plan(text)
    except PlanError:
        return
    assert 0 < len(plan) <= MAX_STEPS


class CountingDecoder(json.JSONDecoder):
    """JSON decoder that counts the characters that it was given to read."""

    def __init__(self):
        super().__init__()
        self.read = 0

    def raw_decode(self, s, idx=0):
        try:
            value, end = super().raw_decode(s, idx)
        except json.JSONDecodeError as error:
            unterminated = error.msg.startswith("Unterminated")
            self.read += (len(s) if unterminated else error.pos) - idx
            raise
        except RecursionError:
            self.read += len(s) - idx
            raise
        self.read += end - idx
        return value, end


@pytest.mark.parametrize("piece", ['[{"a":', '{"a":[', '{"a', '[{"action":"move","x":[', '[ { "b" : '])
def test_work_on_brackets_that_never_close_grows_linearly(piece):
    for size in (4_000, 8_000, 16_000):
        decoder, text = CountingDecoder(), piece * (size // len(piece))
        assert last_json_plan(text, decoder) is None
        assert decoder.read <= 9 * size


@pytest.mark.parametrize(
    ("text", "calls", "done"),
    [
        ("move 3", 1, False),
        ("done", 0, True),
        ("Done.", 0, True),
        ("I see the apple.\nmove 3\ndone", 1, True),
        ("move 3; done; move 4", 1, True),
        ("move 3\nopen 3", 2, False),
        ('{"action": "move", "object_index": 3}', 1, False),
        ('I go there: {"action": "move", "object_index": 3}', 1, False),
        ('```json\n[{"action": "move", "object_index": 3}, {"action": "done"}]\n```', 1, True),
        ('{"action": "done"}', 0, True),
        ('{"action": "move", "object_index": 3}\n{"action": "open", "object_index": 3}', 2, False),
        ('{"action": "move", "object_index": 3}, {"action": "done"}', 1, True),
        ('{"action": "move", "object_index": 3}. No: {"action": "open", "object_index": 3}', 1, False),
        ('[{"action": "move", "object_index": 3}]\n{"action": "open", "object_index": 4}', 1, False),
        ('{"plan": [{"action": "done"}]}', 0, True),
        ("<think>done</think>move 3", 1, False),
        ("Action: `move 3`", 1, False),
        ("**open(3)**.", 1, False),
        ("place(3, inside)", 1, False),
        ("move_forward 0.5 0.25", 1, False),
        ("pick_up 3.", 1, False),
        ("Done!", 0, True),
    ],
)
def test_answer_of_an_episode_has_calls_and_may_end_it(text, calls, done):
    plan, ends = parse_answer(text)
    assert (len(plan), ends) == (calls, done)


@pytest.mark.parametrize("text", ["", "well done", "I am done with it", "{}", '{"action": 3}', "dance 3"])
def test_answer_without_call_and_end_is_refused(text):
    with pytest.raises(PlanError):
        parse_answer(text)
