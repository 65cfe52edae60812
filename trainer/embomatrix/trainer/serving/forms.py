"""Published request forms of vLLM and SGLang: plans by token ids with log-probabilities, and new weights.

Forms of vLLM 0.33 (completions, dynamic LoRA adapters) and SGLang 0.5.23 (native API, dynamic LoRA adapters).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from pydantic import BaseModel, TypeAdapter

from embomatrix.trainer.config.settings import ServerKind
from embomatrix.trainer.policy.protocol import Tokens
from embomatrix.world.json_text import parse_json

TOKEN_ID: Final = "token_id:"
"""Prefix of a token in the answers of vLLM versions that return no list of token ids."""
MAX_TOKEN: Final = 2**31
"""Larger token ids belong to no vocabulary. They would overflow a tensor."""
ROUNDING: Final = 1e-3
"""Largest positive log-probability that rounding explains."""


_WHOLE_DISTRIBUTION: Final[Mapping[str, float]] = {
    "top_p": 1.0,
    "top_k": -1,
    "min_p": 0.0,
    "repetition_penalty": 1.0,
    "presence_penalty": 0.0,
    "frequency_penalty": 0.0,
}
"""Sampling parameters that the server's options or the model's generation_config.json would change."""


class AnswerError(Exception):
    """Answer without the promised contents. Its text says what is missing."""


class AbortedError(Exception):
    """The server gave up a plan, for example because it shuts down."""


class OldWeightsError(Exception):
    """The server sampled from other weights than the last ones, for example after a restart."""


@dataclass(frozen=True, slots=True)
class Weights:
    """Weights of one moment in a folder: adapters in peft's format, or a whole model. No other weights have this ``name``."""

    name: str
    folder: Path
    are_adapters: bool


@dataclass(frozen=True, slots=True)
class PlanRequest:
    """Request for ``group`` plans per prompt. A plan ends after one of the ``end_tokens``, or after ``max_new`` tokens."""

    prompts: Sequence[Tokens]
    group: int
    temperature: float
    max_new: int
    end_tokens: Sequence[int]
    seed: int


@dataclass(frozen=True, slots=True)
class ServedPlan:
    """Plan of a model server: its tokens up to the end, their log-probabilities, and the server's text of them."""

    tokens: Tokens
    logprobs: tuple[float, ...]
    text: str


@dataclass(frozen=True, slots=True)
class ServerCall:
    """HTTP request: a POST of ``body`` as JSON."""

    path: str
    body: Mapping[str, Any]


class RequestForm(Protocol):
    """Form of one kind of server."""

    advice: str
    """Options with which the server must be started to load adapters."""
    context_option: str
    """Option for the longest prompt and plan."""

    def sampling(self, request: PlanRequest, weights: Weights) -> ServerCall: ...

    def plans(self, answer: bytes, request: PlanRequest, weights: Weights) -> list[ServedPlan]:
        """Return the plans in the order of the prompts. Raises AnswerError, AbortedError and OldWeightsError."""
        ...

    def loading(self, weights: Weights) -> ServerCall: ...

    def unloading(self, weights: Weights) -> ServerCall | None:
        """Return the request that removes the weights from the server. None: the next weights replace them."""
        ...


class _Logprobs(BaseModel):
    tokens: list[str] = []
    token_logprobs: list[float | None] = []


class _Choice(BaseModel):
    index: int
    text: str = ""
    finish_reason: str | None = None
    logprobs: _Logprobs | None = None
    token_ids: list[int] | None = None


class _Completions(BaseModel):
    choices: list[_Choice]


class VllmForm:
    """vLLM: completions with a list of prompts, and LoRA adapters that are loaded while it runs.

    Each adapter has a new name, because some versions of vLLM find cached prefixes of a prompt by the adapter's name alone:
    with ``load_inplace``, new plans would begin with the keys and values of old weights.
    """

    advice = (
        "with VLLM_ALLOW_RUNTIME_LORA_UPDATING=True, --enable-lora and --max-lora-rank of at least lora.rank"
    )
    context_option = "--max-model-len"

    def sampling(self, request: PlanRequest, weights: Weights) -> ServerCall:
        body = {
            "model": weights.name,
            "prompt": [list(prompt) for prompt in request.prompts],
            "n": request.group,
            "max_tokens": request.max_new,
            "temperature": request.temperature,
            **_WHOLE_DISTRIBUTION,
            "seed": request.seed,
            "stop_token_ids": list(request.end_tokens),
            "logprobs": 0,
            "return_token_ids": True,
            "return_tokens_as_token_ids": True,
        }
        return ServerCall("/v1/completions", body)

    def plans(self, answer: bytes, request: PlanRequest, weights: Weights) -> list[ServedPlan]:
        try:
            choices = _Completions.model_validate(parse_json(answer)).choices
        except ValueError as error:
            raise AnswerError("its answer is not a list of completions") from error
        _check_number(len(choices), request)
        return [_vllm_plan(choice) for choice in sorted(choices, key=lambda choice: choice.index)]

    def loading(self, weights: Weights) -> ServerCall:
        return ServerCall(
            "/v1/load_lora_adapter", {"lora_name": weights.name, "lora_path": str(weights.folder)}
        )

    def unloading(self, weights: Weights) -> ServerCall | None:
        return ServerCall("/v1/unload_lora_adapter", {"lora_name": weights.name})


def _vllm_plan(choice: _Choice) -> ServedPlan:
    if choice.finish_reason in ("abort", "error"):
        raise AbortedError("it aborted a plan")
    if choice.logprobs is None:
        raise AnswerError("it returns no log-probabilities")
    tokens = choice.token_ids
    if tokens is None:
        numbers = [
            token.removeprefix(TOKEN_ID) for token in choice.logprobs.tokens if token.startswith(TOKEN_ID)
        ]
        tokens = [
            int(number) for number in numbers if number.isdecimal() and len(number) < len(str(MAX_TOKEN))
        ]
        if len(tokens) != len(choice.logprobs.tokens):
            raise AnswerError("it returns no token ids")
    return _checked(tokens, choice.logprobs.token_logprobs, choice.text)


class _Finish(BaseModel):
    type: str = ""
    message: str = ""


class _Meta(BaseModel):
    finish_reason: _Finish | None = None
    output_token_logprobs: list[tuple[float | None, int, str | None]] | None = None
    weight_version: str | None = None


class _Generation(BaseModel):
    text: str = ""
    meta_info: _Meta


_GENERATIONS: Final = TypeAdapter(list[_Generation])


class SglangForm:
    """SGLang: its native API with a list of prompts, and adapters or whole models that are loaded while it runs."""

    advice = "with --enable-lora, --max-lora-rank of at least lora.rank and --lora-target-modules all"
    context_option = "--context-length"

    def sampling(self, request: PlanRequest, weights: Weights) -> ServerCall:
        body: dict[str, Any] = {
            # Each prompt as often as it has plans: their order in the answer is then that of the rows.
            "input_ids": [list(prompt) for prompt in request.prompts for _ in range(request.group)],
            "sampling_params": {
                "max_new_tokens": request.max_new,
                "temperature": request.temperature,
                **_WHOLE_DISTRIBUTION,
                "stop_token_ids": list(request.end_tokens),
            },
            "return_logprob": True,
        }
        if weights.are_adapters:
            body["lora_path"] = weights.name
        return ServerCall("/generate", body)

    def plans(self, answer: bytes, request: PlanRequest, weights: Weights) -> list[ServedPlan]:
        try:
            found = _GENERATIONS.validate_python(parse_json(answer))
        except ValueError as error:
            raise AnswerError("its answer is not a list of generations") from error
        _check_number(len(found), request)
        return [_sglang_plan(each, weights) for each in found]

    def loading(self, weights: Weights) -> ServerCall:
        if weights.are_adapters:
            body = {"lora_name": weights.name, "lora_path": str(weights.folder)}
            return ServerCall("/load_lora_adapter", body)
        version = {"model_path": str(weights.folder), "weight_version": weights.name}
        return ServerCall("/update_weights_from_disk", version)

    def unloading(self, weights: Weights) -> ServerCall | None:
        return (
            ServerCall("/unload_lora_adapter", {"lora_name": weights.name}) if weights.are_adapters else None
        )


def _sglang_plan(found: _Generation, weights: Weights) -> ServedPlan:
    meta = found.meta_info
    if meta.finish_reason is not None and meta.finish_reason.type == "abort":
        raise AbortedError(f"it aborted a plan ({meta.finish_reason.message or 'no reason'})")
    if not weights.are_adapters and meta.weight_version != weights.name:
        raise OldWeightsError(f"it sampled from the weights {meta.weight_version!r}")
    if meta.output_token_logprobs is None:
        raise AnswerError("it returns no log-probabilities")
    tokens = [token for _, token, _ in meta.output_token_logprobs]
    return _checked(tokens, [logprob for logprob, _, _ in meta.output_token_logprobs], found.text)


def _check_number(found: int, request: PlanRequest) -> None:
    expected = len(request.prompts) * request.group
    if found != expected:
        raise AnswerError(f"it returns {found} plans for {expected}")


def _checked(tokens: Sequence[int], logprobs: Sequence[float | None], text: str) -> ServedPlan:
    """Return a plan whose tokens all have a log-probability. Raises AnswerError."""
    known = tuple(each for each in logprobs if each is not None and math.isfinite(each) and each <= ROUNDING)
    if not tokens or len(tokens) != len(known):
        raise AnswerError(f"it returns {len(known)} log-probabilities for a plan of {len(tokens)} tokens")
    if not all(0 <= token < MAX_TOKEN for token in tokens):
        raise AnswerError("it returns token ids that no tokenizer has")
    return ServedPlan(tuple(tokens), known, text)


FORMS: Final[Mapping[ServerKind, RequestForm]] = {
    ServerKind.VLLM: VllmForm(),
    ServerKind.SGLANG: SglangForm(),
}
