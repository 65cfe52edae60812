"""OpenEnv environment and server: an action is the text of an answer; each session plays one episode after another.

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

from embomatrix.envs.environment import Environment as Episodes
from embomatrix.envs.environment import PlayedEpisode
from embomatrix.envs.opening import make
from embomatrix.envs.rules import EpisodeRules
from embomatrix.skills.syntax import MAX_STEPS

SESSIONS: Final = 4
"""Concurrent episodes."""
RULES: Final = EpisodeRules(calls_per_answer=MAX_STEPS, ends_at_goal=True)
"""Rules of episodes, if no others are given: an answer may be a call or a whole plan."""


class AnswerAction(Action):
    """Answer of the policy: calls as ``move 3`` or JSON, or ``done``."""

    text: str


class HouseholdObservation(Observation):
    """Text for the policy, and the outcome of each call of its answer (``messages``).

    ``end`` is the reason why the episode is over, empty while it goes on.
    """

    text: str
    messages: list[str] = []  # noqa: RUF012  # pydantic copies it
    end: str = ""


class HouseholdState(State):
    """Task id, the tiers of the reward so far, and the calls."""

    task_id: str = ""
    success: bool = False
    format: float = 0.0
    relevance: float = 0.0
    goal: float = 0.0
    failed_calls: int = 0


class HouseholdEnvironment(Environment[AnswerAction, HouseholdObservation, HouseholdState]):
    """Tasks of a split. ``reset(seed=…)`` draws one, ``reset(task_id=…)`` names it.

    The reward of a step is the change of the episode's reward, so its steps add up to that.
    """

    SUPPORTS_CONCURRENT_SESSIONS = True

    def __init__(self, episodes: Episodes) -> None:
        super().__init__()
        self._episodes = episodes
        self._episode: PlayedEpisode | None = None
        self._total = 0.0
        self._state = HouseholdState()

    def reset(
        self,
        seed: int | None = None,
        episode_id: str | None = None,
        *,
        task_id: str = "",
        **_: Any,
    ) -> HouseholdObservation:
        """Begin an episode. Raises DatasetError for an unknown task, and what executing a turn raises."""
        draw = np.random.default_rng(seed)
        task_ids = self._episodes.task_ids
        named = task_id or task_ids[int(draw.integers(len(task_ids)))]
        (self._episode,) = self._episodes.begin([(named, int(draw.integers(2**31)))])
        self._total = 0.0
        self._state = HouseholdState(episode_id=episode_id or uuid.uuid4().hex, step_count=0, task_id=named)
        prompt = self._episode.prompt
        return HouseholdObservation(text=f"{prompt.system}\n\n{prompt.user}", reward=0.0, done=False)

    def step(self, action: AnswerAction, timeout_s: float | None = None, **_: Any) -> HouseholdObservation:
        """Take an answer. Raises RuntimeError before ``reset`` and after the end."""
        if self._episode is None:
            raise RuntimeError("no episode was begun: call reset first")
        (observation,) = self._episodes.answer([self._episode], [action.text])
        reward = observation.reward
        gain, self._total = reward.total - self._total, reward.total
        self._state = self._state.model_copy(
            update={
                "step_count": reward.calls,
                "failed_calls": reward.failures,
                "success": reward.tiers.success,
                **reward.tiers.tiers,
            }
        )
        return HouseholdObservation(
            text=observation.text,
            messages=[*observation.messages],
            end=observation.end or "",
            reward=gain,
            done=observation.end is not None,
        )

    @property
    def state(self) -> HouseholdState:
        """State of the current episode."""
        return self._state

    def close(self) -> None:
        """Give up the episode. The simulators serve other sessions too."""
        self._episode = None


def server(
    dataset: str | Path,
    split: str = "train",
    sessions: int = SESSIONS,
    visibility: str | None = None,
    rules: EpisodeRules = RULES,
    **cluster: Any,
) -> Any:
    """ASGI application with at most this many concurrent sessions.

    Episodes are executed in this process, or on the cluster that the arguments ``manager``, ``token`` and ``ca`` of
    ``envs.make`` name. Raises what ``envs.make`` raises.
    """
    episodes = make(dataset, split=split, visibility=visibility, rules=rules, **cluster)
    environment = functools.partial(HouseholdEnvironment, episodes)
    return create_app(
        environment, AnswerAction, HouseholdObservation, env_name="embomatrix", max_concurrent_envs=sessions
    )
