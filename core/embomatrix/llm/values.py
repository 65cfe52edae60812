"""Questions to a language model and its answers, independent of the server."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Protocol


class Speaker(StrEnum):
    SYSTEM = "system"
    USER = "user"
    ASSISTANT = "assistant"


@dataclass(frozen=True, slots=True)
class Message:
    """One turn. ``images`` are PNG files, for vision models."""

    speaker: Speaker
    text: str
    images: tuple[bytes, ...] = field(default=(), repr=False)


@dataclass(frozen=True, slots=True)
class ChatRequest:
    """One question. ``purpose`` names the asking component, for ledger and errors; it is not sent.

    ``json_schema`` is the form of the answer. The endpoint sends it or quotes it in the prompt.
    """

    purpose: str
    messages: tuple[Message, ...]
    max_tokens: int = 2048
    temperature: float = 0.7
    seed: int | None = None
    json_schema: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Usage:
    """Token counts of the endpoint; 0 where it reports none."""

    prompt_tokens: int = 0
    completion_tokens: int = 0


@dataclass(frozen=True, slots=True)
class Reply:
    """Answer of a model. ``finish`` is the endpoint's reason: "stop", or "length" for text that was cut off."""

    text: str
    model: str
    usage: Usage
    finish: str
    seconds: float
    retries: int = 0


class ChatModel(Protocol):
    """Anything that answers questions. Raises LlmError."""

    async def complete(self, request: ChatRequest) -> Reply: ...


class LlmError(Exception):
    """Raised when a language model gave no usable answer. The message is one sentence for people."""


class EndpointError(LlmError):
    """Raised when the endpoint is unreachable, refuses, or answers with something other than a chat completion.

    ``status`` is the HTTP status of a refusal that is not worth another try, else 0.
    """

    def __init__(self, sentence: str, status: int = 0) -> None:
        super().__init__(sentence)
        self.status = status


class UnusableReplyError(LlmError):
    """Raised when no answer had the requested form."""


class CassetteError(LlmError):
    """Raised when a recording can't be read or lacks the question."""
