"""Adapter for Inspect AI: a task that plays episodes, with the skills as tools.

``inspect eval embomatrix/household --model NAME`` runs it, and ``-T split=train`` sets an argument.
"""

import asyncio
import functools
from collections.abc import Callable
from typing import Any, Final

try:
    from inspect_ai import Task, task
    from inspect_ai.dataset import MemoryDataset, Sample
    from inspect_ai.model import ChatMessageSystem, ChatMessageUser
    from inspect_ai.scorer import Score, Scorer, Target, accuracy, mean, scorer, stderr
    from inspect_ai.solver import Generate, Solver, TaskState, solver
    from inspect_ai.tool import Tool, ToolDef
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"embomatrix.envs.inspect_ai needs the package {error.name}: pip install 'inspect-ai>=0.3.285'",
        name=error.name,
    ) from None

from embomatrix.envs.environment import Environment
from embomatrix.envs.opening import make_where_named
from embomatrix.envs.rules import EpisodeReward, EpisodeRules, Visibility, rules_of
from embomatrix.envs.tools import TOOLS, PaperTools, system_text
from embomatrix.skills.seeds import evaluation_seed
from embomatrix.skills.syntax import MAX_STEPS, PROFILES
from embomatrix.starter.shipped import STARTER
from embomatrix.world.task import Profile

_REWARD: Final = "embomatrix:reward"
"""Key of an episode's reward in the store of its sample."""


@task
def household(
    dataset: str = STARTER,
    split: str = "heldout",
    visibility: str = Visibility.SEEN.value,
    calls: int = MAX_STEPS,
    manager: str = "",
    seed: int = 0,
) -> Task:
    """Episodes of the tasks of a dataset: ``starter`` or ``search``, which ship, or a folder.

    They are executed in this process, or on the cluster that ``manager`` or ``EMBOMATRIX_MANAGER`` names. Seeds are those of
    ``embomatrix eval``. Raises ValueError for an unknown visibility, DatasetError, and ClusterError if the manager
    refuses.
    """
    rules = rules_of(EpisodeRules(calls=calls), visibility)
    environment = make_where_named(dataset, split, rules, manager)
    samples = [
        Sample(
            input=record.task.instruction,
            id=record.task.task_id,
            metadata={
                "profile": record.task.profile.value,
                "category": record.task.category.value,
                "seed": evaluation_seed(seed, record.task.task_id),
            },
        )
        for record in environment.records
    ]
    return Task(
        dataset=MemoryDataset(samples, name=f"{dataset} {split}"),
        solver=play_episode(environment),
        scorer=final_state(),
    )


@solver
def play_episode(environment: Environment) -> Solver:
    """Let the model call skills until it answers without a call, or the rules of the environment end the episode."""

    async def solve(state: TaskState, generate: Generate) -> TaskState:
        kind = TOOLS[Profile(state.metadata["profile"])]
        tools = kind(environment)
        opening = await asyncio.to_thread(tools.reset, str(state.sample_id), int(state.metadata["seed"]))
        state.messages = [
            ChatMessageSystem(content=system_text(environment, kind.profile)),
            ChatMessageUser(content=opening),
        ]
        state.tools = as_inspect_tools(tools)
        player = tools.episode.player
        try:
            while player.end is None and not state.completed:
                state = await generate(state, tool_calls="single")
                if not state.output.choices or not state.output.message.tool_calls:
                    break
        finally:
            # Inspect also scores samples that a limit of messages, tokens or time ends here.
            state.store.set(_REWARD, _numbers(player.reward))
        return state

    return solve


@scorer(
    metrics={
        "success": [accuracy(), stderr()],
        "reward": [mean(), stderr()],
        "calls": [mean()],
        "failed_calls": [mean()],
    }
)
def final_state() -> Scorer:
    """Success and reward of the state that an episode reached, and its calls."""

    async def score(state: TaskState, target: Target) -> Score:
        return Score(value=state.store.get(_REWARD))

    return score


def _numbers(reward: EpisodeReward) -> dict[str, float]:
    return {"reward": reward.total, **reward.metrics}


def as_inspect_tools(tools: PaperTools) -> list[Tool]:
    """Return the skills of an episode as Inspect's tools. They run in threads: Inspect plays many episodes at a time."""
    methods = [getattr(tools, skill.value) for skill in PROFILES[tools.profile]]
    return [ToolDef(_in_thread(method)).as_tool() for method in methods]


def _in_thread(method: Callable[..., str]) -> Callable[..., Any]:
    @functools.wraps(method)
    async def execute(*arguments: object, **named: object) -> str:
        return await asyncio.to_thread(method, *arguments, **named)

    return execute
