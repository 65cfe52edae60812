"""Sampling of a Hugging Face policy's plans by a model server, which gets the policy's weights after each update.

The server samples from token ids and returns token ids, so the tokens that learn are the tokens that were sampled.
"""

from __future__ import annotations

import contextlib
import itertools
import shutil
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from pathlib import Path
from typing import Final

import torch

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import ServerKind, TrainSettings
from embomatrix.trainer.learning.data_parallel import RemoteLearner
from embomatrix.trainer.learning.learner import Learner, SamplingParams
from embomatrix.trainer.lifecycle.checkpoint import atomic_folder
from embomatrix.trainer.policy.hf import HfPolicy
from embomatrix.trainer.policy.protocol import Samples, Tokens
from embomatrix.trainer.serving.forms import PlanRequest, ServedPlan, Weights
from embomatrix.trainer.serving.server import ModelServer

PROBE_PLANS: Final = 2
PROBE_TOKENS: Final = 16
"""Tokens of each plan in the check at the start."""
ROUNDING_NATS: Final = 0.01
"""Mean difference of log-probabilities that 16-bit arithmetic explains."""


Draw = Callable[[Learner | RemoteLearner], Samples]
"""Function that returns samples. The learner draws them, or a model server has begun to."""


class ServerSampler:
    """Policy on a model server, which samples its plans. ``folder`` is for the weights that the server reads."""

    def __init__(self, policy: HfPolicy, server: ModelServer, folder: Path) -> None:
        self._policy = policy
        self._server = server
        self._folder = folder.absolute()
        self._vocabulary = int(policy.module.get_output_embeddings().weight.shape[0])
        # Weights of an earlier run may still be on the server: no two runs share a name.
        run = uuid.uuid4().hex[:8]
        self._names = (f"embomatrix-{run}-{number}" for number in itertools.count())
        self._kept: Path | None = None

    def begin(self, prompts: Sequence[Tokens], seed: int, rule: SamplingParams) -> Callable[[], Samples]:
        """Begin to draw plans. Return a function that waits for them and raises TrainerError."""
        ends = self._policy.end_tokens
        future = self._server.plans(
            PlanRequest(prompts, rule.group, rule.temperature, rule.max_new, ends, seed)
        )
        return lambda: self._samples(future)

    def _samples(self, future: Future[list[ServedPlan]]) -> Samples:
        plans = future.result()
        largest = max(max(plan.tokens) for plan in plans)
        if largest >= self._vocabulary:
            raise TrainerError(
                f"the model server {self._server.url} sampled the token {largest}, and {self._policy.name} has "
                f"{self._vocabulary} tokens: serve the model that is trained"
            )
        return self._policy.samples_of([plan.tokens for plan in plans], [plan.logprobs for plan in plans])

    def publish(self) -> None:
        """Give the policy's present weights to the server. Raises TrainerError."""
        self._hand_over(self._written(), self._server.load)

    def _written(self) -> Weights:
        """Write the policy's present weights under a new name."""
        folder = self._folder / next(self._names)
        with atomic_folder(folder) as partial:
            inner = self._policy.save_for_server(partial).relative_to(partial)
        return Weights(folder.name, folder / inner, self._policy.has_adapters)

    def _hand_over(self, weights: Weights, load: Callable[[Weights], None]) -> None:
        former, self._kept = self._kept, self._folder / weights.name
        try:
            load(weights)
        finally:
            if former is not None:
                shutil.rmtree(former, ignore_errors=True)

    def close(self) -> None:
        """Remove the weights' folder."""
        if self._kept is not None:
            shutil.rmtree(self._kept, ignore_errors=True)
        with contextlib.suppress(OSError):
            self._folder.rmdir()

    def check(self, longest: Tokens, settings: TrainSettings) -> None:
        """Load the weights and sample once. ``longest`` is the longest prompt of the run.

        Raises TrainerError with a remedy if the server is away, has too short a context, can't load weights, returns no
        log-probabilities, or serves another model.
        """
        self._check_context(len(longest) + settings.grpo.max_new)
        weights = self._written()
        try:
            self._hand_over(weights, self._server.load_once)
        except TrainerError as error:
            adapters = (
                f"; for adapters start it {self._server.form.advice}" if self._policy.has_adapters else ""
            )
            raise TrainerError(
                f"{error}; it must be able to read the weights in {self._folder} (sampler.folder){adapters}"
            ) from error
        temperature = settings.grpo.temperature
        rule = SamplingParams(PROBE_PLANS, temperature, min(PROBE_TOKENS, settings.grpo.max_new))
        samples = self.begin((longest,), settings.seed, rule)()
        gap = self._gap(longest, samples, temperature)
        if gap > ROUNDING_NATS and self._gap(longest, samples, 1.0) < gap / 2:
            raise TrainerError(
                f"the model server {self._server.url} returns log-probabilities at temperature 1, and grpo.temperature is "
                f"{temperature:g}: start vLLM with --logprobs-mode processed_logprobs, SGLang without "
                "SGLANG_RETURN_ORIGINAL_LOGPROB, or set the temperature to 1"
            )
        if gap > settings.sampler.tolerance:
            raise TrainerError(
                f"the log-probabilities of the model server {self._server.url} differ from those of {self._policy.name} by "
                f"{gap:.2f} nats per token, expected at most {settings.sampler.tolerance:g} (sampler.tolerance): it serves "
                "another model or tokenizer; start it with the model that is trained"
            )

    def _check_context(self, needed: int) -> None:
        """Raise TrainerError if the server lists no model, or one whose prompts and plans are too short."""
        base = next((model for model in self._server.models() if model.parent is None), None)
        if base is None:
            raise TrainerError(
                f"the model server {self._server.url} lists no model: start it with the model that is trained"
            )
        if base.max_model_len is not None and base.max_model_len < needed:
            raise TrainerError(
                f"the model server {self._server.url} takes {base.max_model_len} tokens with {base.id}, and the longest prompt "
                f"and plan have {needed}: start it with {self._server.form.context_option} {needed}, or lower prompt.rows or "
                "grpo.max_new"
            )

    @torch.no_grad()
    def _gap(self, prompt: Tokens, samples: Samples, temperature: float) -> float:
        """Mean difference in nats between the server's log-probabilities and the policy's at a temperature."""
        own = self._policy.logprobs((prompt,), samples.tokens, samples.mask, PROBE_PLANS, temperature)
        return float((samples.logprobs - own.logprobs)[samples.mask].abs().mean())


def begin_drawing(
    server: ServerSampler | None, prompts: Sequence[Tokens], seed: int, rule: SamplingParams
) -> Draw:
    """Return the function that draws plans of the prompts. A model server begins at once, a learner when it is called."""
    if server is None:
        return lambda learner: learner.sample(prompts, seed, rule)
    wait = server.begin(prompts, seed, rule)
    return lambda _: wait()


@contextlib.contextmanager
def open_sampler(
    policy: HfPolicy, settings: TrainSettings, longest: Tokens, out: Path, *, key: str
) -> Iterator[ServerSampler]:
    """Connect to the server of the settings and check it. ``out`` is the run's folder. Raises TrainerError."""
    if settings.sampler.kind is ServerKind.VLLM and not policy.has_adapters:
        raise TrainerError(
            "sampler.kind: vLLM loads adapters while it runs, but no whole model from a folder: set lora.rank, or serve the "
            "model with SGLang and set sampler.kind to sglang"
        )
    folder = Path(settings.sampler.folder) if settings.sampler.folder else out / "sampler"
    with ModelServer(settings.sampler, key=key) as server:
        sampler = ServerSampler(policy, server, folder)
        try:
            sampler.check(longest, settings)
            yield sampler
        finally:
            sampler.close()
