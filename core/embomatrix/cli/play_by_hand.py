"""A task played by hand: one call a line, each answered at once."""

from collections.abc import Callable
from typing import Final

from embomatrix.cli.plan_text import doubtful_angles, plan_with_names
from embomatrix.envs.environment import Environment
from embomatrix.envs.episode import Episode
from embomatrix.envs.rules import EpisodeReward
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.skills.parse import PlanError, PlanReason
from embomatrix.skills.prompt import Codec, prompt_for, skill_line
from embomatrix.skills.syntax import MAX_STEPS, PROFILES, Plan, SkillCall
from embomatrix.world.task import Task

HELP: Final = (
    "One call a line, with a row or a name: `move 3`, `pick_up apple_1`, `place 0 inside`. `state` shows where everything is, "
    "`restart` begins again, `help` lists the calls, `done` or `quit` ends. A failed call changes nothing."
)

EXPLORING: Final = (
    "One call a line, with the number after an object's name: `move 3`. You know what the robot has seen: `state` shows it. "
    "`done` says that the task is fulfilled, `help` lists the calls, `quit` ends. A failed call changes nothing."
)


def play_by_hand(
    episode: Episode, read: Callable[[], str | None], show: Callable[[str], None], seed: int
) -> tuple[RewardBreakdown | None, Plan]:
    """Execute the calls that ``read`` returns until the goal is reached, ``MAX_STEPS`` calls were made or the input ends.

    ``read`` returns None at the end of the input. Return the reward of the state reached, None without any call, and the
    calls that succeeded: as a plan they lead to this state.
    """
    show(HELP)
    reward: RewardBreakdown | None = None
    done: list[SkillCall] = []
    while (line := read()) is not None and (words := line.split()) not in (["quit"], ["done"]):
        if words == ["state"]:
            show("\n".join(episode.state()))
        elif words == ["help"]:
            show("\n".join([HELP, *map(skill_line, PROFILES[episode.task.profile])]))
        elif words == ["restart"]:
            episode.reset(seed)
            reward = None
            done.clear()
            show("the scene is as it was at the start")
        elif words:
            try:
                call = call_in(line, episode.task)
            except PlanError as error:
                show(f"{error}; `help` lists the calls")
                continue
            outcome = episode.act(call)
            reward = outcome.reward
            if outcome.step.ok:
                done.append(call)
            show(f"{'✓' if outcome.step.ok else '✗'} {outcome.step.message}")
            for doubt in doubtful_angles([call]):
                show(doubt)
            if reward.success:
                show("the goal is reached")
                break
            if outcome.over:
                show(f"a plan has at most {MAX_STEPS} calls")
                break
    return reward, tuple(done)


def explore_by_hand(
    environment: Environment,
    task_id: str,
    seed: int,
    read: Callable[[], str | None],
    show: Callable[[str], None],
) -> EpisodeReward | None:
    """Play an episode of the environment by the lines that ``read`` returns, None at the end of the input.

    Return the reward of the state reached, None if no call succeeded.
    """
    (episode,) = environment.begin([(task_id, seed)])
    show(episode.prompt.user)
    show(EXPLORING)
    player = episode.player
    while (line := read()) is not None and (words := line.split()) != ["quit"]:
        if words == ["help"]:
            show("\n".join([EXPLORING, *map(skill_line, PROFILES[player.observer.situation.profile])]))
        elif words == ["state"]:
            rooms = ", ".join(player.observer.situation.home)
            show(f"Rooms: {rooms}\n{prompt_for(player.observer.situation, Codec.LINES).user}")
        elif words:
            (observation,) = environment.answer([episode], [line])
            show(observation.text)
            for doubt in doubtful_angles(step.call for step in observation.steps):
                show(doubt)
            if observation.end is not None:
                show(f"the episode is over: {observation.end}")
                break
    return player.reward if any(step.ok for step in player.steps) else None


def call_in(line: str, task: Task) -> SkillCall:
    """Return the one call in a line, in which names of objects stand for their rows. Raises PlanError."""
    try:
        plan = plan_with_names(line, task)
    except PlanError as error:
        if error.reason is PlanReason.NO_PLAN:
            raise PlanError(
                PlanReason.NO_PLAN, f"found {line.strip()[:80]!r}: expected one call, such as `move 3`"
            ) from error
        raise
    if len(plan) != 1:
        raise PlanError(PlanReason.TOO_MANY_STEPS, f"found {len(plan)} calls: expected one call a line")
    return plan[0]
