"""A process beside the trainer's: it holds the same policy, in the same memory, and does what it is asked until it is left."""

from __future__ import annotations

import pickle
import signal
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import torch

from embomatrix.trainer.config.errors import DAMAGE, TrainerError
from embomatrix.trainer.config.settings import TrainSettings
from embomatrix.trainer.grpo.learner import Learner
from embomatrix.trainer.grpo.shared_memory import SharedTensors
from embomatrix.trainer.policy.loading import saved_policy

if TYPE_CHECKING:
    from multiprocessing.connection import Connection
    from pathlib import Path

    from torch import nn

    from embomatrix.trainer.grpo.learner import Lesson
    from embomatrix.trainer.grpo.objective import LossMetrics


class Descriptor(Protocol):
    """A file that was handed on to a new process, as `multiprocessing.reduction.DupFd` makes them."""

    def detach(self) -> int:
        """Its number in the new process."""
        ...


@dataclass(frozen=True, slots=True)
class Workplace:
    """What a helper needs: ``reference`` is the folder of the policy as imitation left it, ``weights`` the memory of the policy
    as it is now, ``gradient`` that of this helper's gradients."""

    settings: dict[str, Any]
    reference: Path
    weights: Descriptor
    gradient: Descriptor


class _Helper:
    """The requests that ``RemoteLearner`` sends, by name."""

    def __init__(self, place: Workplace) -> None:
        settings = TrainSettings.model_validate(place.settings)
        torch.set_num_threads(settings.threads)
        policy = saved_policy(place.reference, settings)
        reference = saved_policy(place.reference, settings).frozen_copy()
        self._weights: list[nn.Parameter] = list(policy.parameters())
        now = SharedTensors(self._weights, place.weights.detach())
        for parameter, shared in zip(self._weights, now.tensors, strict=True):
            parameter.data = shared
        now.close()
        self._gradient = SharedTensors(self._weights, place.gradient.detach())
        self._gradient.close()
        self._learner = Learner(policy, reference, settings.grpo)
        self.sample = self._learner.sample
        self.of_reference = self._learner.of_reference

    def learn(self, lesson: Lesson) -> tuple[LossMetrics, list[bool]]:
        """The part's gradient lies in the shared memory afterwards; of each parameter, whether it has one."""
        for parameter in self._weights:
            parameter.grad = None
        metrics = self._learner.learn(lesson)
        has = []
        for parameter, shared in zip(self._weights, self._gradient.tensors, strict=True):
            has.append(parameter.grad is not None)
            if parameter.grad is not None:
                shared.copy_(parameter.grad)
        return metrics, has


def serve(connection: Connection, place: Workplace) -> None:
    """Answer requests until the other side is gone. An interrupt is the trainer's to handle."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    helper: _Helper | None = None
    while True:
        try:
            name, arguments = pickle.loads(connection.recv_bytes())
        except EOFError:
            return
        try:
            helper = helper or _Helper(place)
            reply = (True, getattr(helper, name)(*arguments))
        except (TrainerError, MemoryError, *DAMAGE) as error:
            reply = (False, f"{type(error).__name__}: {error}")
        try:
            connection.send_bytes(pickle.dumps(reply))
        except BrokenPipeError:
            return
