"""Check of a result against its plan and the reward coefficients of its run.

It needs no simulator: a result that fails it contradicts itself, whatever the scene. Audits check the rest.
"""

import itertools

from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.reward.settings import RewardSettings
from embomatrix.rpc.wire.values import Completed, Rollout
from embomatrix.skills.syntax import MAX_STEPS, Plan
from embomatrix.skills.trace import Step
from embomatrix.world.task import MAX_TABLE


def contradiction(completed: Completed, rollout: Rollout, settings: RewardSettings) -> str:
    """Return the reason why no execution of the plan can have this result; empty if one can."""
    if completed.shared_steps > len(completed.steps):
        return f"it shares {completed.shared_steps} of its {len(completed.steps)} steps"
    prefix = rollout.prefix
    if (completed.observation is None) != (prefix is None):
        return (
            "it has an observation, and its rollout is no turn" if prefix is None else "it has no observation"
        )
    before, plan = _split(rollout)
    return (
        _wrong_sight(completed, rollout)
        or _wrong_advice(completed, rollout)
        or _wrong_steps(completed.steps, plan)
        or _wrong_reward(
            completed.reward, (*before, *(step.call for step in completed.steps if step.ok)), settings
        )
    )


def _wrong_sight(completed: Completed, rollout: Rollout) -> str:
    observation = completed.observation
    if observation is None:
        return ""
    if observation.looked != rollout.sight or (observation.sees and not observation.looked):
        return "it says what the robot sees, and its turn is without sight"
    if any(row >= after for row, after in itertools.pairwise((*observation.sees, MAX_TABLE))):
        return "the rows that the robot sees are no rising indices of a table"
    return ""


def _wrong_advice(completed: Completed, rollout: Rollout) -> str:
    advice = completed.observation.advice if completed.observation is not None else None
    if advice is None:
        return ""
    if not rollout.advise:
        return "it has the oracle's advice, and its turn did not ask for it"
    if len(advice.plan) > MAX_STEPS or (advice.plan and advice.problem):
        return f"its advice has {len(advice.plan)} calls and the problem {advice.problem[:100]!r}"
    rows = {row for call in advice.plan for row in (call.object_index, call.source_index) if row is not None}
    return (
        "its advice names rows beyond any table"
        if rows and not 0 <= min(rows) <= max(rows) < MAX_TABLE
        else ""
    )


def _split(rollout: Rollout) -> tuple[Plan, Plan]:
    """Return the calls of the prefix that succeeded, and the calls after the prefix."""
    prefix = rollout.prefix
    if prefix is None:
        return (), rollout.plan
    done = (call for index, call in enumerate(rollout.plan[: prefix.length]) if index not in prefix.failed)
    return tuple(done), rollout.plan[prefix.length :]


def _wrong_steps(steps: tuple[Step, ...], plan: Plan) -> str:
    if len(steps) > len(plan):
        return f"it has {len(steps)} steps for a plan of {len(plan)} calls"
    if tuple([step.call for step in steps]) != plan[: len(steps)]:
        return "its steps are other calls than the plan's"
    failures = [step.failure for step in steps]
    if any(failures[:-1]):
        return "it goes on after a failed step"
    if len(steps) < len(plan) and not (failures and failures[-1]):
        return f"it ends after {len(steps)} of {len(plan)} calls without a failure"
    return ""


def _wrong_reward(reward: RewardBreakdown, done: Plan, settings: RewardSettings) -> str:
    """Recompute the tiers as `embomatrix.reward.hierarchy.score` does, to the bit."""
    satisfied = sum(atom.holds for atom in reward.atoms)
    goal = settings.goal * satisfied / len(reward.atoms) if reward.atoms else 0.0
    if reward.format != settings.format:
        return f"its format reward is {reward.format:g} instead of {settings.format:g}"
    if reward.goal != goal:
        return f"its goal reward is {reward.goal:g}, and its atoms earn {goal:g}"
    if reward.success != (0 < len(reward.atoms) == satisfied):
        said = "succeeds" if reward.success else "fails"
        return f"it {said}, and {satisfied} of its {len(reward.atoms)} atoms hold"
    return "" if _is_relevance(reward.relevance, done, settings) else _irrelevant(reward.relevance)


def _irrelevant(relevance: float) -> str:
    return f"no number of touched objects earns its relevance reward of {relevance:g}"


def _is_relevance(relevance: float, done: Plan, settings: RewardSettings) -> bool:
    """True if some of the objects that successful calls can have touched earn this relevance reward.

    A call touches its target and its source. Calls without an index act on the held object.
    """
    if relevance == 0.0:
        return True
    named = {call.object_index for call in done} | {call.source_index for call in done}
    most = len(named - {None})
    return any(
        relevance == min(settings.relevance_limit, settings.relevance_per_object * count)
        for count in range(1, most + 1)
    )
