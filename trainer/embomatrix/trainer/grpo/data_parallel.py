"""The processes of a trainer. Part ``n`` of a step belongs to process ``n`` modulo their number; the first is this one."""

from __future__ import annotations

import multiprocessing
import pickle
from concurrent.futures import ThreadPoolExecutor
from multiprocessing.reduction import DupFd
from typing import TYPE_CHECKING, Any, Self, TypeVar

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.grpo.remote import Workplace, serve
from embomatrix.trainer.grpo.shared_memory import SharedTensors

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from concurrent.futures import Future
    from pathlib import Path
    from types import TracebackType

    from torch import Tensor

    from embomatrix.trainer.config.settings import TrainSettings
    from embomatrix.trainer.grpo.learner import Learner, Lesson, Sampling
    from embomatrix.trainer.grpo.objective import LossMetrics
    from embomatrix.trainer.policy.protocol import Policy, Samples, Tokens

T = TypeVar("T")


class RemoteLearner:
    """A helper, and the thread that speaks with it: what is asked of it is done one after the other."""

    def __init__(self, number: int, settings: TrainSettings, reference: Path, weights: SharedTensors) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._gradient = SharedTensors(weights.tensors)
        self._connection, theirs = spawn.Pipe()
        place = Workplace(
            settings.model_dump(mode="json"), reference, DupFd(weights.fd), DupFd(self._gradient.fd)
        )
        self._name = f"trainer-{number}"
        self._process = spawn.Process(target=serve, args=(theirs, place), name=self._name, daemon=True)
        self._process.start()
        theirs.close()
        self._gradient.close()
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=self._name)
        self.closed = False

    def run(self, job: Callable[[RemoteLearner], T]) -> Future[T]:
        """Have ``job`` work with this helper when its turn comes. It waits for nobody else: an interrupt would wait for it."""
        return self._thread.submit(job, self)

    def sample(self, prompts: Sequence[Tokens], seed: int) -> Samples:
        samples: Samples = self._asked("sample", tuple(prompts), seed)
        return samples

    def of_reference(self, prompts: Sequence[Tokens], tokens: Tensor, mask: Tensor) -> Tensor:
        scored: Tensor = self._asked("of_reference", tuple(prompts), tokens, mask)
        return scored

    def learn(self, lesson: Lesson) -> tuple[LossMetrics, list[Tensor | None]]:
        """A part's metrics, and its gradient by parameter."""
        metrics, has = self._asked("learn", lesson)
        shared = self._gradient.tensors
        return metrics, [each.clone() if there else None for each, there in zip(shared, has, strict=True)]

    def _asked(self, name: str, *arguments: object) -> Any:
        try:
            self._connection.send_bytes(pickle.dumps((name, arguments)))
            done, reply = pickle.loads(self._connection.recv_bytes())
        except (EOFError, OSError) as error:
            self._process.join(timeout=5)
            raise TrainerError(
                f"the process {self._name} ended in mid-step (exit code {self._process.exitcode}, which is -9 where the "
                "system had no memory left): go on with --resume, with fewer `processes` where memory is short"
            ) from error
        if not done:
            raise TrainerError(f"the process {self._name} can't go on ({reply}): go on with --resume")
        return reply

    def close(self) -> None:
        """End the process, whatever it does."""
        self.closed = True
        self._process.kill()
        self._process.join()
        self._thread.shutdown(wait=True, cancel_futures=True)
        self._connection.close()


class Crew:
    """This process and its helpers, which see each change of the policy's weights at once: they lie in shared memory."""

    def __init__(self, own: Learner, helpers: Sequence[RemoteLearner] = ()) -> None:
        self.own = own
        self._helpers = tuple(helpers)

    @classmethod
    def of(cls, own: Learner, policy: Policy, settings: TrainSettings, reference: Path) -> Self:
        """With as many helpers as the settings want beside this process; ``reference`` is the reference policy's folder.

        Raises TrainerError where the policy is not on a processor.
        """
        if settings.processes == 1:
            return cls(own)
        if settings.device != "cpu":
            raise TrainerError(
                f"processes = {settings.processes} share a policy in a processor's memory, and the device is "
                f"{settings.device}: pass --processes=1"
            )
        learning = list(policy.parameters())
        weights = SharedTensors([parameter.data for parameter in learning])
        for parameter, shared in zip(learning, weights.tensors, strict=True):
            shared.copy_(parameter.data)
            parameter.data = shared
        helpers = [
            RemoteLearner(number, settings, reference, weights) for number in range(1, settings.processes)
        ]
        weights.close()
        return cls(own, helpers)

    def helper(self, part: int) -> RemoteLearner | None:
        """Whose part it is; None: this process's."""
        turn = part % (len(self._helpers) + 1)
        return self._helpers[turn - 1] if turn else None

    def spread(self, jobs: Sequence[tuple[int, Callable[[Sampling], T]]]) -> list[T]:
        """Do jobs, each with the number of its part, in the processes that they belong to; results are in their order."""
        elsewhere = {
            at: helper.run(job)
            for at, (part, job) in enumerate(jobs)
            if (helper := self.helper(part)) is not None
        }
        here = {at: job(self.own) for at, (_, job) in enumerate(jobs) if at not in elsewhere}
        return [here[at] if at in here else elsewhere[at].result() for at in range(len(jobs))]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for helper in self._helpers:
            helper.close()
