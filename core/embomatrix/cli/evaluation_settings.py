"""Settings of `embomatrix eval`, and where it executes plans and episodes."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, ConfigDict, Field

from embomatrix.envs.rules import Visibility
from embomatrix.envs.simulation import ClusterSimulation, Simulation
from embomatrix.host.limits import usable_cores
from embomatrix.skills.prompt import Codec
from embomatrix.skills.syntax import MAX_STEPS
from embomatrix.trainer.eai.exam import NativeExam
from embomatrix.trainer.evaluation.answers import MOST_SAMPLES
from embomatrix.trainer.evaluation.benchmark import Benchmark
from embomatrix.trainer.evaluation.episodes import EpisodeExam, EpisodeRunner
from embomatrix.trainer.evaluation.exam import WorldExam
from embomatrix.world.task import Profile

if TYPE_CHECKING:
    from embomatrix.rpc.client import ClusterClient
    from embomatrix.trainer.cluster.executor import Executor

Exam = WorldExam | EpisodeExam | NativeExam


class EvalSettings(BaseModel):
    """Settings of an evaluation. Options of the command override those of the TOML file."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)
    samples: int = Field(10, ge=1, le=MOST_SAMPLES)
    """Plans per task."""
    temperature: float = Field(1.0, ge=0)
    """Sampling temperature. 0: greedy."""
    seed: int = Field(0, ge=0)
    """Seed of sampling and execution."""
    tasks: int | None = Field(None, ge=1)
    """Evaluate only the first tasks."""
    max_tokens: int | None = Field(None, ge=1)
    """Maximum tokens of an answer. Default: as the model was trained here, 1024 for all other models and endpoints."""
    codec: Codec | None = None
    """Plan format of a language model. Default: as it was trained here, else JSON."""
    profile: Profile = Profile.HOUSEHOLD
    """paper: tasks that need another household skill count as failed."""
    concurrent: int = Field(8, ge=1)
    """Concurrent requests to the endpoint."""
    attempts: int = Field(6, ge=1)
    """Attempts per request, with waits between."""
    jobs: int | None = Field(None, ge=1)
    """Simulator processes without a manager. Default: one per core."""
    threads: int | None = Field(None, ge=1)
    """torch threads."""
    device: str = "cpu"
    """torch device of a local model: cpu or cuda."""
    interactive: bool = False
    """Play episodes: one call an answer, each after the observation of the last (docs/episodes.md)."""
    visibility: Visibility = Visibility.FULL
    """Part of the task that episodes show. full: the whole table of the task. seen: what the robot has seen."""
    calls_factor: float = Field(2.0, ge=1, le=64)
    """Budget of calls of an episode, as a multiple of the oracle's."""
    calls_more: int = Field(12, ge=0, le=MAX_STEPS)
    """Calls of an episode besides."""


@dataclass(frozen=True, slots=True)
class Cluster:
    """Place where plans and episodes are executed: a manager's cluster, or this machine without an address."""

    manager: str
    token: str
    ca: Path | None
    jobs: int | None

    def executor(self, bench: Benchmark) -> Executor:
        """Executor of plans."""
        if not self.manager:
            from embomatrix.worker.slots.rollout_pool import RolloutPool

            return RolloutPool(bench.folder, self.jobs or usable_cores())
        from embomatrix.trainer.cluster.executor import ClusterExecutor

        return ClusterExecutor(self._connect(), bench.dataset.bundle_bytes)

    def simulation(self, bench: Benchmark) -> Simulation:
        """Simulation of episodes, in this process if there is no manager."""
        if not self.manager:
            from embomatrix.envs.turns import LocalSimulation

            return LocalSimulation(bench.dataset)
        return ClusterSimulation(bench.dataset, self._connect())

    def _connect(self) -> Callable[[], ClusterClient]:
        from embomatrix.rpc.client import ClusterClient
        from embomatrix.rpc.trust import read_ca, read_token

        return functools.partial(ClusterClient, self.manager, read_token(self.token), ca=read_ca(self.ca))


def world_exam(cluster: Cluster, bench: Benchmark, *, interactive: bool) -> WorldExam | EpisodeExam:
    if interactive:
        return EpisodeExam(bench, EpisodeRunner(bench, functools.partial(cluster.simulation, bench)))
    return WorldExam(bench, cluster.executor(bench))
