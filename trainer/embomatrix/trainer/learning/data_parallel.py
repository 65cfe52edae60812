"""Data-parallel workers: processes that sample and back-propagate microbatches side by side, in imitation and GRPO.

Microbatch ``n`` of a step belongs to process ``n`` modulo the number of processes. Process 0 is the trainer itself.
All processes see the same weights in shared memory.
"""

from __future__ import annotations

import contextlib
import functools
import mmap
import multiprocessing
import os
import pickle
import signal
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from multiprocessing.connection import Connection
from multiprocessing.reduction import DupFd
from pathlib import Path
from typing import Any, Final, Self, TypeVar

import torch
from torch import Tensor

from embomatrix.host.anonymous_memory import nameless_file
from embomatrix.trainer.config.errors import DAMAGE, TrainerError, reason_of
from embomatrix.trainer.config.settings import TrainSettings
from embomatrix.trainer.learning.learner import Learner, Microbatch, SamplingParams
from embomatrix.trainer.learning.objective import LossMetrics
from embomatrix.trainer.lifecycle.checkpoint import atomic_folder
from embomatrix.trainer.policy.loading import saved_policy
from embomatrix.trainer.policy.protocol import ImitationExample, Policy, Samples, Tokens

T = TypeVar("T")
_ALIGNMENT_BYTES: Final = 64
"""Alignment of each tensor: the width of the widest vector instructions."""


class SharedTensors:
    """Tensors with the shapes and dtypes of ``like`` in one anonymous shared-memory file.

    Without ``fd`` the memory is new and zero. torch's own sharing is not used: it needs /dev/shm, 64 MB in a container.
    """

    def __init__(self, like: Sequence[Tensor], fd: int | None = None) -> None:
        sizes = [each.numel() * each.element_size() for each in like]
        offsets = [0]
        for size in sizes:
            offsets.append(offsets[-1] + -(-size // _ALIGNMENT_BYTES) * _ALIGNMENT_BYTES)
        self.fd = nameless_file("embomatrix-trainer", offsets[-1]) if fd is None else fd
        memory = mmap.mmap(self.fd, offsets[-1])
        self.tensors = tuple(
            torch.frombuffer(memory, dtype=each.dtype, count=each.numel(), offset=offset).view(each.shape)
            for each, offset in zip(like, offsets, strict=False)
        )

    def close(self) -> None:
        """Close the descriptor. The memory lives as long as one of its tensors."""
        os.close(self.fd)


class RemoteLearner:
    """Learner in another process. Its requests are executed one after the other."""

    def __init__(self, number: int, settings: TrainSettings, folder: Path, weights: SharedTensors) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._gradient = SharedTensors(weights.tensors)
        self._connection, remote_end = spawn.Pipe()
        self._name = f"trainer-{number}"
        memory = (DupFd(weights.fd), DupFd(self._gradient.fd))
        self._process = spawn.Process(
            target=_serve,
            args=(remote_end, settings.model_dump(mode="json"), folder, *memory),
            name=self._name,
            daemon=True,
        )
        self._process.start()
        remote_end.close()
        self._gradient.close()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=self._name)
        self.closed = False

    def run(self, job: Callable[[RemoteLearner], T]) -> Future[T]:
        """Queue ``job`` on this learner's thread. The job must not wait for other jobs, nor longer than a second for anything
        once this learner is closed, or Ctrl-C would wait too."""
        return self._thread.submit(job, self)

    def use_reference(self, folder: Path) -> None:
        """Load the reference policy, which GRPO needs."""
        self._request("use_reference", folder)

    def sample(self, prompts: Sequence[Tokens], seed: int, rule: SamplingParams) -> Samples:
        samples: Samples = self._request("sample", tuple(prompts), seed, rule)
        return samples

    def begin_episodes(self, number: int, prompts: Sequence[Tokens], seed: int, rule: SamplingParams) -> None:
        self._request("begin_episodes", number, tuple(prompts), seed, rule)

    def answer_episodes(
        self, number: int, rows: Sequence[int], observations: Sequence[str]
    ) -> list[str | None]:
        answers: list[str | None] = self._request("answer_episodes", number, tuple(rows), tuple(observations))
        return answers

    def end_episodes(self, number: int) -> Samples:
        samples: Samples = self._request("end_episodes", number)
        return samples

    def current_logprobs(self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor) -> Tensor:
        logprobs: Tensor = self._request("current_logprobs", tuple(prompts), tokens, mask)
        return logprobs

    def reference_logprobs(self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor) -> Tensor:
        logprobs: Tensor = self._request("reference_logprobs", tuple(prompts), tokens, mask)
        return logprobs

    def learn(self, microbatch: Microbatch) -> tuple[LossMetrics, list[Tensor | None]]:
        """Return the metrics of a microbatch, and its gradient by parameter."""
        metrics, has_gradient = self._request("learn", microbatch)
        return metrics, self._gradients(has_gradient)

    def imitate(self, examples: Sequence[ImitationExample], tokens: int) -> tuple[float, list[Tensor | None]]:
        """Return the loss of the examples, and its gradient by parameter."""
        loss, has_gradient = self._request("imitate", tuple(examples), tokens)
        return loss, self._gradients(has_gradient)

    def _gradients(self, present: Sequence[bool]) -> list[Tensor | None]:
        """Copy the gradient that the process has written to shared memory."""
        shared = self._gradient.tensors
        return [each.clone() if found else None for each, found in zip(shared, present, strict=True)]

    def _request(self, name: str, *arguments: object) -> Any:
        try:
            self._connection.send_bytes(pickle.dumps((name, arguments)))
            succeeded, reply = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError) as error:
            self._process.join(timeout=5)
            raise TrainerError(
                f"the process {self._name} ended during a step (exit code {self._process.exitcode}; -9 usually means out of "
                "memory): continue with --resume, and lower `processes` if memory is short"
            ) from error
        if not succeeded:
            raise TrainerError(f"the process {self._name} failed ({reply}): continue with --resume")
        return reply

    def close(self) -> None:
        """Kill the process, even in the middle of a request."""
        self.closed = True
        self._process.kill()
        self._process.join()
        self._thread.shutdown(wait=True, cancel_futures=True)
        self._connection.close()


class _Requests:
    """Methods that ``RemoteLearner`` calls by name in the other process."""

    def __init__(self, settings: TrainSettings, folder: Path, weights_fd: int, gradient_fd: int) -> None:
        torch.set_num_threads(settings.threads)
        policy = saved_policy(folder, settings)
        self._weights = list(policy.parameters())
        shared = SharedTensors(self._weights, weights_fd)
        for parameter, tensor in zip(self._weights, shared.tensors, strict=True):
            parameter.data = tensor
        shared.close()
        self._gradient = SharedTensors(self._weights, gradient_fd)
        self._gradient.close()
        self._settings = settings
        self._learner = Learner(policy, None, settings.grpo)
        self.sample = self._learner.sample
        self.begin_episodes = self._learner.begin_episodes
        self.answer_episodes = self._learner.answer_episodes
        self.end_episodes = self._learner.end_episodes
        self.current_logprobs = self._learner.current_logprobs
        self.reference_logprobs = self._learner.reference_logprobs

    def use_reference(self, folder: Path) -> None:
        self._learner.reference = saved_policy(folder, self._settings).frozen_copy()

    def learn(self, microbatch: Microbatch) -> tuple[LossMetrics, list[bool]]:
        return self._with_gradient(functools.partial(self._learner.learn, microbatch))

    def imitate(self, examples: Sequence[ImitationExample], tokens: int) -> tuple[float, list[bool]]:
        return self._with_gradient(functools.partial(self._learner.imitate, examples, tokens))

    def _with_gradient(self, job: Callable[[], T]) -> tuple[T, list[bool]]:
        """Write the job's gradient to shared memory. The list marks the parameters with a gradient."""
        for parameter in self._weights:
            parameter.grad = None
        result = job()
        for parameter, shared in zip(self._weights, self._gradient.tensors, strict=True):
            if parameter.grad is not None:
                shared.copy_(parameter.grad)
        return result, [parameter.grad is not None for parameter in self._weights]


def _serve(
    connection: Connection, settings: dict[str, Any], folder: Path, weights: Any, gradient: Any
) -> None:
    """Answer requests until the trainer closes the connection. The trainer handles Ctrl-C and SIGTERM for all processes.

    ``folder`` holds the policy, whose weights are replaced by the shared ones; ``weights`` and ``gradient`` are descriptors
    from DupFd.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    requests: _Requests | None = None
    while True:
        try:
            name, arguments = pickle.loads(connection.recv_bytes())
        except EOFError:
            return
        try:
            if requests is None:
                parsed = TrainSettings.model_validate(settings)
                requests = _Requests(parsed, folder, weights.detach(), gradient.detach())
            reply = (True, getattr(requests, name)(*arguments))
        except (TrainerError, MemoryError, *DAMAGE) as error:
            reply = (False, f"{type(error).__name__}: {error}")
        try:
            connection.send_bytes(pickle.dumps(reply))
        except BrokenPipeError:
            return


class DataParallelWorkers:
    """The trainer's own learner and its remote learners. Weight updates are visible to all of them at once."""

    def __init__(self, local: Learner, remotes: Sequence[RemoteLearner] = ()) -> None:
        self.local = local
        self._remotes = tuple(remotes)

    @classmethod
    @contextlib.contextmanager
    def start(cls, policy: Policy, settings: TrainSettings) -> Iterator[Self]:
        """Start ``settings.processes - 1`` remote learners, on the CPU, and end them with the block. Raises TrainerError."""
        local = Learner(policy, None, settings.grpo)
        if settings.processes == 1:
            yield cls(local)
            return
        learning = list(policy.parameters())
        try:
            weights = SharedTensors([parameter.data for parameter in learning])
        except OSError as error:
            raise TrainerError(
                f"the weights can't be put into shared memory ({reason_of(error)}): free memory, or set processes to 1"
            ) from error
        for parameter, shared in zip(learning, weights.tensors, strict=True):
            shared.copy_(parameter.data)
            parameter.data = shared
        with tempfile.TemporaryDirectory(prefix="embomatrix-policy-") as name:
            with atomic_folder(Path(name) / "policy") as folder:
                policy.save(folder)
            remotes = [
                RemoteLearner(number, settings, Path(name) / "policy", weights)
                for number in range(1, settings.processes)
            ]
            weights.close()
            try:
                yield cls(local, remotes)
            finally:
                for remote in remotes:
                    remote.close()

    @property
    def count(self) -> int:
        """Number of learners."""
        return 1 + len(self._remotes)

    @property
    def has_remotes(self) -> bool:
        return bool(self._remotes)

    def use_reference(self, reference: Policy, folder: Path) -> None:
        """Give all learners the reference policy, which ``folder`` holds too."""
        self.local.reference = reference
        for loading in [remote.run(lambda each: each.use_reference(folder)) for remote in self._remotes]:
            loading.result()

    def remote(self, index: int) -> RemoteLearner | None:
        """Return the owner of the microbatch with this index. None: this process."""
        owner = index % (len(self._remotes) + 1)
        return self._remotes[owner - 1] if owner else None

    def map(self, jobs: Sequence[tuple[int, Callable[[Learner | RemoteLearner], T]]]) -> list[T]:
        """Run (microbatch index, job) pairs on the learners that own them. Results keep the order of the jobs."""
        futures = {
            at: remote.run(job)
            for at, (index, job) in enumerate(jobs)
            if (remote := self.remote(index)) is not None
        }
        local = {at: job(self.local) for at, (_, job) in enumerate(jobs) if at not in futures}
        return [local[at] if at in local else futures[at].result() for at in range(len(jobs))]
