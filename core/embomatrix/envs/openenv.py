"""OpenEnv environment and server: an action is the text of a call or of a whole plan; each episode is one task.

Needs ``openenv``, which no other module needs. ``uvicorn.run(server("build/dataset"))`` serves it.
"""

import functools
import uuid
from pathlib import Path
from typing import Any, Final

import numpy as np

try:
    from openenv.core.env_server.http_server import create_app
    from openenv.core.env_server.interfaces import Environment
    from openenv.core.env_server.types import Action, Observation, State
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"embomatrix.envs.openenv needs the package {error.name}: pip install 'openenv>=0.10'",
        name=error.name,
    ) from None

from embomatrix.envs.episode import Episode, Household
from embomatrix.reward.settings import PAPER
from embomatrix.skills.parse import PlanError, parse_plan

SESSIONS: Final = 4
"""Concurrent episodes. Each has its own simulators, about 100 MB per scene."""


class PlanAction(Action):
    """Calls in a plan's syntax, ``move 3`` or JSON, executed up to the first failure."""

    text: str


class HouseholdObservation(Observation):
    """Prompt (``task``), one line per object (``state``) and the outcome of each call (``messages``)."""

    task: str
    state: list[str]
    messages: list[str] = []  # noqa: RUF012  # pydantic copies it


class HouseholdState(State):
    """Task id and the tiers of the reward so far."""

    task_id: str = ""
    success: bool = False
    format: float = 0.0
    relevance: float = 0.0
    goal: float = 0.0


class HouseholdEnvironment(Environment[PlanAction, HouseholdObservation, HouseholdState]):
    """Tasks of a dataset. ``reset(seed=…)`` draws one, ``reset(task_id=…)`` names it.

    The reward of a step is the gain of its calls; text that is not a plan changes nothing and gets −1. An episode is done at
    the goal or after 64 calls.
    """

    SUPPORTS_CONCURRENT_SESSIONS = True

    def __init__(self, dataset: str | Path, split: str = "train") -> None:
        super().__init__()
        self._household = Household(dataset)
        self._task_ids = [record.task.task_id for record in self._household.records if record.split == split]
        self._episode: Episode | None = None
        self._state = HouseholdState()

    def reset(
        self,
        seed: int | None = None,
        episode_id: str | None = None,
        *,
        task_id: str = "",
        **_: Any,
    ) -> HouseholdObservation:
        """Start an episode. Raises DatasetError for an unknown task."""
        draw = np.random.default_rng(seed)
        named = task_id or self._task_ids[int(draw.integers(len(self._task_ids)))]
        self._episode = self._household.episode(named)
        self._episode.reset(int(draw.integers(2**31)))
        self._state = HouseholdState(episode_id=episode_id or uuid.uuid4().hex, step_count=0, task_id=named)
        return self._observation(self._episode, 0.0, [], done=False)

    def step(self, action: PlanAction, timeout_s: float | None = None, **_: Any) -> HouseholdObservation:
        """Execute the calls of a text, up to the first that fails."""
        if self._episode is None:
            raise RuntimeError("no episode was begun: call reset first")
        try:
            plan = parse_plan(action.text, self._episode.task.profile)
        except PlanError as error:
            return self._observation(self._episode, PAPER.unparsable, [str(error)], done=False)
        gain, messages, done = 0.0, [], False
        for call in plan:
            outcome = self._episode.act(call)
            gain += outcome.gain
            messages.append(outcome.step.message)
            reward = outcome.reward
            done = reward.success or outcome.over
            self._state = self._state.model_copy(
                update={
                    "step_count": self._state.step_count + 1,
                    "success": reward.success,
                    **reward.tiers,
                }
            )
            if done or not outcome.step.ok:
                break
        return self._observation(self._episode, gain, messages, done=done)

    @property
    def state(self) -> HouseholdState:
        """State of the current episode."""
        return self._state

    def close(self) -> None:
        """Free the simulators."""
        self._household.close()

    def _observation(
        self, episode: Episode, gain: float, messages: list[str], *, done: bool
    ) -> HouseholdObservation:
        prompt = episode.prompt()
        return HouseholdObservation(
            task=f"{prompt.system}\n\n{prompt.user}",
            state=list(episode.state()),
            messages=messages,
            reward=gain,
            done=done,
        )


def server(dataset: str | Path, split: str = "train", sessions: int = SESSIONS) -> Any:
    """ASGI application with at most this many concurrent sessions."""
    environment = functools.partial(HouseholdEnvironment, dataset, split)
    return create_app(
        environment, PlanAction, HouseholdObservation, env_name="embomatrix", max_concurrent_envs=sessions
    )
