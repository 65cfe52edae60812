"""A task played by hand: one call a line, each answered at once."""

from collections.abc import Callable, Sequence
from typing import Final

from embomatrix.envs.episode import Episode
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.skills.parse import PlanError, parse_plan
from embomatrix.skills.syntax import MAX_STEPS, SkillCall
from embomatrix.world.task import Task

HELP: Final = (
    "One call a line, with a row or a name: `move 3`, `pick_up apple_1`, `place 0 inside`. `state` shows where everything is, "
    "`restart` begins again, `quit` ends. A failed call changes nothing."
)


def play_by_hand(
    episode: Episode, read: Callable[[], str | None], show: Callable[[str], None], seed: int
) -> RewardBreakdown | None:
    """Execute the calls that ``read`` returns until the goal is reached, ``MAX_STEPS`` calls were made or the input ends.

    ``read`` returns None at the end of the input. Return the reward of the state reached, None without any call.
    """
    show(HELP)
    reward: RewardBreakdown | None = None
    while (line := read()) is not None and (words := line.split()) != ["quit"]:
        if words == ["state"]:
            show("\n".join(episode.state()))
        elif words == ["restart"]:
            episode.reset(seed)
            reward = None
            show("the scene is as it was at the start")
        elif words:
            try:
                call = call_in(words, episode.task)
            except PlanError as error:
                show(f"{error}. {HELP}")
                continue
            outcome = episode.act(call)
            reward = outcome.reward
            show(f"{'✓' if outcome.step.ok else '✗'} {outcome.step.message}")
            if reward.success:
                show("the goal is reached")
                break
            if outcome.over:
                show(f"a plan has at most {MAX_STEPS} calls")
                break
    return reward


def call_in(words: Sequence[str], task: Task) -> SkillCall:
    """Return the one call in a line, in which names of objects stand for their rows. Raises PlanError."""
    rows = {name: str(row) for row, name in enumerate(task.table)}
    skill, *arguments = words
    plan = parse_plan(" ".join([skill, *(rows.get(word, word) for word in arguments)]), task.profile)
    return plan[0]
