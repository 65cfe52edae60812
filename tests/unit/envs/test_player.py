"""Episodes played by answers: rules, budgets, ends, and what a policy that sees only a part is told."""

import asyncio
import dataclasses

import pytest

from embomatrix.envs.player import EpisodePlayer
from embomatrix.envs.rules import EpisodeEnd, EpisodeRules, Visibility
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.turns import EpisodeStart, RunningEpisode, Turn
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.prompt import Codec, PromptRow, Situation
from embomatrix.skills.trace import Step
from embomatrix.skills.turns import TurnObservation
from embomatrix.world.state import Relation

ROWS = (
    PromptRow(0, "table_1", "table", "kitchen_0", fixed=True),
    PromptRow(1, "apple_1", "apple", "kitchen_0", "table_1", Relation.ONTOP),
    PromptRow(2, "fridge_1", "fridge", "kitchen_0", states=("closed",), fixed=True),
    PromptRow(3, "milk_1", "milk", "kitchen_0", "fridge_1", Relation.INSIDE, ("cold",)),
    PromptRow(4, "bed_1", "bed", "bedroom_0", fixed=True),
)
SITUATION = Situation(
    ("kitchen_0", "bedroom_0"), "kitchen_0", ROWS, "Cool the apple.", 5, home=("kitchen_0", "bedroom_0")
)
FULL = EpisodeRules()
SEEN = EpisodeRules(Visibility.SEEN)


class Kitchen:
    """Simulator of this kitchen: ``open 2`` shows the milk, ``pick_up 3`` fails, ``close 2`` reaches the goal."""

    def __init__(self):
        self.executed = []
        self.opened = False

    async def take_turn(self, start, plan, prefix, *, advise=False):
        calls = plan[prefix.length :]
        self.executed += calls
        steps, changes, success = [], [], False
        for call in calls:
            words = f"{call.skill} {call.object_index}"
            if call.room_name:
                sentence = f"there is no room {call.room_name}: the rooms are kitchen_0, bedroom_0"
                steps.append(Step(call, FailureReason.UNKNOWN_ROOM, sentence))
                break
            if words == "pick_up 3":
                sentence = "bed_1 is in the way of milk_1 and of shelf_7"
                steps.append(Step(call, FailureReason.BLOCKED, sentence, "bed_1"))
                break
            steps.append(Step(call, None, f"did it to {ROWS[call.object_index or 0].name}"))
            self.opened |= words == "open 2"
            if words == "open 2":
                changes.append("fridge_1: in kitchen_0, open")
            success = words == "close 2"
        sees = (0, 1, 2, 3) if self.opened else (0, 1)
        observation = TurnObservation(
            "kitchen_0", (), tuple(changes), start.sight, sees if start.sight else ()
        )
        reward = RewardBreakdown(format=1.0, relevance=0.0, goal=30.0 * success, atoms=(), success=success)
        return Turn(tuple(steps), observation, reward, f"sha256:{len(plan)}")


def play(answers, rules=FULL, codec=Codec.LINES, *, opens=False):
    """Return the player, its kitchen, the opening prompt and the observations after the answers.

    With ``opens``, the fridge and what is in it come into sight after the opening prompt.
    """
    kitchen = Kitchen()
    start = EpisodeStart("sha256:0", "t", 0, sight=rules.visibility is Visibility.SEEN)
    player = EpisodePlayer(RunningEpisode(start, kitchen.take_turn), SITUATION, rules, codec)

    async def run():
        prompt = await player.begin()
        kitchen.opened = opens
        return prompt, [await player.answer(text) for text in answers]

    prompt, observations = asyncio.run(run())
    return player, kitchen, prompt, observations


def test_observation_tells_outcome_changes_and_robot():
    _, _, _, (opened, failed) = play(["open 2", "pick_up 3"])
    assert opened.text == (
        "open 2: did it to fridge 2\nChanged: fridge 2 open, in kitchen_0\nRobot: kitchen_0, hand empty"
    )
    assert failed.text == (
        "pick_up 3: failed (blocked): bed 4 is in the way of milk 3 and of shelf\nRobot: kitchen_0, hand empty"
    )
    assert (failed.reward.calls, failed.reward.failures, failed.end) == (2, 1, None)


def state_after(*answers, rules=FULL):
    return play(answers, rules)[0].state


def test_state_is_equal_whatever_led_to_it():
    assert state_after("open 2", "move 1") == state_after(
        "move 0", "open 2", "pick_up 3", "nonsense", "move 1"
    )
    assert hash(state_after("move 1")) == hash(state_after("move 0", "move 1"))
    assert state_after("move 1") != state_after("move 0")
    assert state_after("move 1") != state_after("move 1", "turn 1.5") != state_after("move 1", "turn 0.5")
    assert state_after("move 1", "turn 1.5", "move 1") == state_after("move 1")
    assert state_after("open 2") != state_after()
    assert state_after(rules=SEEN) != state_after()  # knowledge is a part of it


def test_only_what_was_seen_is_told_and_may_be_used():
    player, kitchen, prompt, observations = play(["open 2", "move 0", "open 2", "pick_up 3"], SEEN)
    assert "table 0 on: apple 1" in prompt.user
    assert "Rooms: kitchen_0, bedroom_0" in prompt.user
    assert not any(word in prompt.user for word in ("fridge 2", "milk", "bed 4"))
    unseen = "open 2: failed (unknown_index): there is no object with index 2 among those that you have seen"
    assert observations[0].text == observations[2].text == f"{unseen}\nRobot: kitchen_0, hand empty"
    assert [call.skill for call in kitchen.executed] == ["move"]
    assert observations[3].text.startswith("pick_up 3: failed (unknown_index)")
    assert player.observer.memory.keys() == {0, 1}


def test_unseen_row_is_refused_like_one_that_does_not_exist():
    _, _, _, (unseen, absent) = play(["open 4", "open 77"], SEEN)
    assert unseen.text.replace("4", "77") == absent.text
    assert dataclasses.replace(unseen.steps[0], call=None, message="") == dataclasses.replace(
        absent.steps[0], call=None, message=""
    )


def test_a_room_that_is_none_does_not_tell_whether_an_object_of_its_name_exists():
    _, _, _, observations = play(["go_to_room milk_1", "go_to_room milk_9", "go_to_room apple_1"], SEEN)
    for observation, word in zip(observations, ("milk_1", "milk_9", "apple_1"), strict=True):
        assert observation.text.startswith(
            f"go_to_room {word}: failed (unknown_room): there is no room {word}: the rooms are kitchen_0, bedroom_0\n"
        )


def test_messages_have_the_words_of_the_text():
    _, _, _, (failed,) = play(["pick_up 3"], FULL)
    assert failed.messages == ("bed 4 is in the way of milk 3 and of shelf",)
    assert failed.steps[0].message == "bed_1 is in the way of milk_1 and of shelf_7"


def test_calls_with_things_that_their_own_answer_found_are_left_out_and_cost_nothing():
    several = EpisodeRules(Visibility.SEEN, calls_per_answer=4)
    _, kitchen, _, (found,) = play(["turn 1\npick_up 3\nmove 0\ndone"], several, opens=True)
    assert [call.skill for call in kitchen.executed] == ["turn"]
    assert found.text.startswith("Of 3 actions, the first one was tried, and the others left out.\n")
    assert "New: fridge 2" in found.text
    assert "unknown_index" not in found.text
    assert (found.reward.calls, found.reward.failures, found.end) == (1, 0, None)


def test_note_counts_the_calls_that_were_tried():
    _, _, _, (failed,) = play(["pick_up 3\nmove 0\nmove 1"], EpisodeRules(calls_per_answer=2))
    assert failed.text.startswith("Of 3 actions, the first one was tried, and the others left out.\n")


def test_a_word_alone_names_no_object_of_which_others_may_be_unseen():
    _, _, prompt, (short, full) = play(["move apple", "move apple_1"], SEEN, codec=Codec.NAMES)
    assert "apple_1" in prompt.user
    assert short.text.startswith("failed")
    assert full.text.startswith("did")


def test_new_things_are_told_once_with_what_holds_them():
    player, _, _, _ = play([], SEEN)
    kitchen = Kitchen()
    kitchen.opened = True
    player = EpisodePlayer(
        RunningEpisode(EpisodeStart("sha256:0", "t", 0, sight=True), kitchen.take_turn), SITUATION, SEEN
    )

    async def run():
        prompt = await player.begin()
        return prompt, [await player.answer(text) for text in ("move 3", "pick_up 3")]

    prompt, (_, blocked) = asyncio.run(run())
    assert "fridge 2 closed in: milk 3 cold" in prompt.user
    assert "something is in the way of milk 3 and of shelf" in blocked.text
    assert "New:" not in blocked.text


def test_situation_of_the_memory_is_a_prompt_from_here_on():
    player, _, _, _ = play(["open 2"])
    assert player.observer.situation.rows[2].states == ("open",)
    player, _, _, _ = play([], SEEN)
    assert [row.index for row in player.observer.situation.rows] == [0, 1]


@pytest.mark.parametrize(
    ("answers", "rules", "end", "calls", "failures"),
    [
        (["move 0", "done"], FULL, EpisodeEnd.DONE, 1, 0),
        (["done"], FULL, EpisodeEnd.DONE, 0, 0),
        (["move 0\ndone"], FULL, EpisodeEnd.DONE, 1, 0),
        (["close 2"], FULL, None, 1, 0),
        (["close 2"], EpisodeRules(ends_at_goal=True), EpisodeEnd.GOAL, 1, 0),
        (["move 0", "move 1"], EpisodeRules(calls=2), EpisodeEnd.CALLS, 2, 0),
        (["pick_up 3"] * 4, FULL, EpisodeEnd.LOOP, 4, 4),
        (["pick_up 3", "move 0"] * 4, FULL, None, 8, 4),
        (["pick_up 3"] * 9, EpisodeRules(equal_failures=0), None, 9, 9),
        (["hello"] * 4, FULL, EpisodeEnd.LOOP, 4, 4),
        (["hello", "move 0"] * 4, FULL, None, 8, 4),
        (["hello", "hi", "hey", "ho", "ha"], FULL, None, 5, 5),
        (["pick_up 3\ndone"], FULL, None, 1, 1),
        (["move 0\nmove 1\ndone"], FULL, None, 1, 0),
        (["move 0\nmove 1\ndone"], EpisodeRules(calls_per_answer=2), EpisodeEnd.DONE, 2, 0),
        (["move 0\nmove 1"], EpisodeRules(calls=1, calls_per_answer=2), EpisodeEnd.CALLS, 1, 0),
        (["open 4"] * 4, SEEN, EpisodeEnd.LOOP, 4, 4),
    ],
)
def test_episode_ends(answers, rules, end, calls, failures):
    player, _, _, _ = play(answers, rules)
    assert (player.end, player.reward.calls, player.reward.failures) == (end, calls, failures)


def test_over_is_over():
    player, _, _, _ = play(["done"])
    with pytest.raises(RuntimeError, match=r"the episode is over \(done\): begin another"):
        asyncio.run(player.answer("move 0"))


def test_answers_that_are_no_call_are_told_so():
    _, _, _, (prose, two, wrong) = play(["hello", "move 0; move 1", "move 1.5"])
    assert prose.text.startswith(
        "Not an action: expected one on a line of its own, such as open 2, or done\n"
    )
    assert two.text.startswith(
        "Of 2 actions, the first one was tried, and the others left out.\nmove 0: did it to table 0\n"
    )
    assert wrong.text.startswith(
        "Not an action: object_index is 1.5: expected a whole number, that of an object\n"
    )


def test_costs_are_subtracted_and_told_apart():
    rules = EpisodeRules(call_cost=0.5, failure_cost=2.0)
    player, _, _, observations = play(["pick_up 3", "close 2"], rules)
    assert observations[0].reward.total == 1.0 - 0.5 - 2.0
    assert (player.reward.tiers.total, player.reward.cost, player.reward.total) == (31.0, 3.0, 28.0)


def test_episode_without_a_call_earns_what_unparsable_text_earns():
    player, _, _, _ = play(["hello", "done"])
    assert player.reward.total == -1.0


def test_word_level_policies_use_names():
    _, _, prompt, (opened, failed) = play(["open fridge", "pick_up milk"], codec=Codec.NAMES)
    assert prompt.user.startswith("room kitchen_0\n")
    assert opened.text == "did\nfridge open in kitchen_0\nrobot kitchen_0"
    assert failed.text == "failed blocked bed\nrobot kitchen_0"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"calls": 0}, "calls is 0: expected a whole number from 1 to 64"),
        ({"calls_per_answer": 65}, "calls_per_answer is 65: expected a whole number from 1 to 64"),
        ({"equal_failures": -1}, "equal_failures is -1: expected a whole number from 0 to 64"),
        ({"calls": 3.5}, "calls is 3.5: expected a whole number from 1 to 64"),
        ({"call_cost": "a"}, "call_cost is 'a': expected 0 or a positive number"),
        ({"visibility": "some"}, "visibility is 'some': expected one of full, seen"),
        ({"call_cost": -1.0}, "call_cost is -1.0: expected 0 or a positive number"),
        ({"failure_cost": float("nan")}, "failure_cost is nan: expected 0 or a positive number"),
    ],
)
def test_rules_out_of_range_are_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        EpisodeRules(**changes)


def test_rules_of_sight_need_an_episode_with_sight():
    running = RunningEpisode(EpisodeStart("sha256:0", "t", 0), Kitchen().take_turn)
    with pytest.raises(ValueError, match="expected an episode with sight"):
        EpisodePlayer(running, SITUATION, SEEN)


def test_policy_is_told_how_many_calls_an_answer_may_have():
    _, _, one, _ = play([])
    _, _, several, _ = play([], EpisodeRules(calls_per_answer=3))
    assert "Answer only with one action;" in one.system
    assert "Answer only with the next actions, at most 3, one a line;" in several.system


def test_words_for_the_visibility_are_its_members():
    assert EpisodeRules(visibility="seen") == SEEN
