"""Results that contradict their plan or the coefficients of their run."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.fakes.worker import completed, completed_turn

from embomatrix.manager.control.plausibility import contradiction
from embomatrix.reward.breakdown import AtomResult
from embomatrix.reward.settings import PAPER, RewardSettings
from embomatrix.rpc.wire.values import Rollout
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import Skill, SkillCall
from embomatrix.skills.trace import Step
from embomatrix.skills.turns import Advice, EpisodePrefix
from embomatrix.world.task import MAX_TABLE

PLAN = (SkillCall(Skill.MOVE, object_index=3), SkillCall(Skill.OPEN, object_index=4))
ROLLOUT = Rollout("x1", "g", "kitchen", "t", PLAN, 1)
HONEST = completed(plan=PLAN)


def reward(**changes):
    return dataclasses.replace(HONEST, reward=dataclasses.replace(HONEST.reward, **changes))


def steps(*steps):
    return dataclasses.replace(HONEST, steps=steps, reward=dataclasses.replace(HONEST.reward, relevance=0.0))


def test_honest_result_is_accepted():
    assert contradiction(HONEST, ROLLOUT, PAPER) == ""
    failed = Step(PLAN[0], FailureReason.OUT_OF_REACH, "too far")
    assert contradiction(steps(failed), ROLLOUT, PAPER) == ""


@pytest.mark.parametrize(
    ("result", "reason"),
    [
        (reward(goal=1.7e308), "its atoms earn 15"),
        (reward(goal=-1e9), "its atoms earn 15"),
        (reward(goal=30.0), "its atoms earn 15"),
        (reward(format=1e9), "format reward"),
        (reward(relevance=0.6), "no number of touched objects"),
        (reward(relevance=float("nan")), "no number of touched objects"),
        (reward(goal=0.0, atoms=(), success=True), "it succeeds, and 0 of its 0 atoms hold"),
        (reward(goal=0.0, atoms=(AtomResult("a", False),), success=True), "succeeds, and 0 of its 1"),
        (reward(success=True), "it succeeds, and 1 of its 2 atoms hold"),
        (reward(goal=30.0, atoms=(AtomResult("a", True),), success=False), "it fails, and 1 of its 1"),
        (steps(*(Step(PLAN[0], None, "done"),) * 500), "500 steps for a plan of 2 calls"),
        (steps(Step(PLAN[1], None, "done"), Step(PLAN[0], None, "done")), "other calls"),
        (steps(Step(PLAN[0], None, "done")), "ends after 1 of 2"),
        (steps(), "ends after 0 of 2"),
        (
            steps(Step(PLAN[0], FailureReason.OUT_OF_REACH, "too far"), Step(PLAN[1], None, "done")),
            "goes on after a failed step",
        ),
    ],
)
def test_impossible_result_is_named(result, reason):
    assert reason in contradiction(result, ROLLOUT, PAPER)


@given(
    st.builds(
        RewardSettings,
        format=st.floats(0, 9),
        relevance_per_object=st.floats(0, 2),
        relevance_limit=st.floats(0, 5),
        goal=st.floats(0, 1e6),
    ),
    st.lists(st.booleans(), min_size=1, max_size=7),
    st.lists(st.integers(0, 9), max_size=9),
)
def test_every_reward_that_can_be_computed_is_accepted(settings, holds, objects):
    plan = tuple(SkillCall(Skill.MOVE, object_index=index) for index in objects)
    result = completed(reward=settings, plan=plan, holds=tuple(holds))
    assert contradiction(result, dataclasses.replace(ROLLOUT, plan=plan), settings) == ""


TURN = dataclasses.replace(ROLLOUT, plan=(*PLAN, *PLAN), prefix=EpisodePrefix(2, (1,), "sha256:a"))


LOOK = dataclasses.replace(TURN, plan=PLAN, sight=True)


def sees(*rows):
    honest = completed_turn(LOOK)
    return dataclasses.replace(honest, observation=dataclasses.replace(honest.observation, sees=rows))


ASK = dataclasses.replace(TURN, plan=PLAN, advise=True)


def advises(plan, problem=""):
    honest = completed_turn(ASK)
    return dataclasses.replace(
        honest, observation=dataclasses.replace(honest.observation, advice=Advice(plan, problem))
    )


@pytest.mark.parametrize("turn", [TURN, LOOK, ASK, dataclasses.replace(TURN, sight=True)])
def test_honest_turn_reports_the_steps_after_its_prefix(turn):
    assert contradiction(completed_turn(turn), turn, PAPER) == ""


def test_prefix_that_failed_earns_no_relevance():
    first = dataclasses.replace(TURN, plan=PLAN, prefix=EpisodePrefix(1, (0,)))
    honest = completed_turn(first)
    assert honest.reward.relevance == 0.2
    high = dataclasses.replace(honest, reward=dataclasses.replace(honest.reward, relevance=0.4))
    assert "no number of touched objects" in contradiction(high, first, PAPER)
    succeeded = dataclasses.replace(first, prefix=EpisodePrefix(1))
    assert contradiction(high, succeeded, PAPER) == ""


@pytest.mark.parametrize(
    ("result", "turn", "reason"),
    [
        (completed(plan=TURN.plan), TURN, "no observation"),
        (completed_turn(TURN), dataclasses.replace(TURN, prefix=None), "its rollout is no turn"),
        (
            dataclasses.replace(completed_turn(TURN), steps=completed(plan=TURN.plan).steps),
            TURN,
            "4 steps for a plan of 2 calls",
        ),
        (dataclasses.replace(completed_turn(TURN), steps=()), TURN, "ends after 0 of 2"),
        (completed_turn(LOOK), dataclasses.replace(LOOK, sight=False), "its turn is without sight"),
        (sees(2, 1), LOOK, "no rising indices"),
        (sees(1, 1), LOOK, "no rising indices"),
        (sees(MAX_TABLE), LOOK, "no rising indices"),
        (
            completed_turn(ASK),
            dataclasses.replace(ASK, advise=False, sight=False),
            "its turn did not ask for it",
        ),
        (advises(PLAN * 33), ASK, "its advice has 66 calls"),
        (
            advises((dataclasses.replace(PLAN[0], object_index=MAX_TABLE),)),
            ASK,
            "names rows beyond any table",
        ),
        (advises(PLAN, "no way"), ASK, "its advice has 2 calls and the problem 'no way'"),
    ],
)
def test_impossible_turn_is_named(result, turn, reason):
    assert reason in contradiction(result, turn, PAPER)
