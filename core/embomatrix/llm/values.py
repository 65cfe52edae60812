"""What is asked of a language model and what comes back, whatever serves it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from collections.abc import Mapping


class Speaker(StrEnum):
    SYSTEM = "system"
    USER = "user"
    ASSISTANT = "assistant"


@dataclass(frozen=True, slots=True)
class Message:
    """One turn. ``images`` are PNG files, for models that see."""

    speaker: Speaker
    text: str
    images: tuple[bytes, ...] = field(default=(), repr=False)


@dataclass(frozen=True, slots=True)
class ChatRequest:
    """One question. ``purpose`` names who asks, for ledger and errors; it is not sent.

    ``json_schema`` asks endpoints that can constrain their output to do so; replies are validated all the same.
    """

    purpose: str
    messages: tuple[Message, ...]
    max_tokens: int = 2048
    temperature: float = 0.7
    seed: int | None = None
    json_schema: Mapping[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class Usage:
    """Tokens as the endpoint counts them; 0 where it does not say."""

    prompt_tokens: int = 0
    completion_tokens: int = 0


@dataclass(frozen=True, slots=True)
class Reply:
    """``finish`` is the endpoint's word for why it stopped: "stop", or "length" where the text was cut off."""

    text: str
    model: str
    usage: Usage
    finish: str
    seconds: float
    retries: int = 0


class ChatModel(Protocol):
    """Whatever answers. Raises LlmError."""

    async def complete(self, request: ChatRequest) -> Reply: ...


class LlmError(Exception):
    """A language model gave no usable answer; one sentence for a person."""


class EndpointError(LlmError):
    """The endpoint can't be reached, refuses, or answers what is no chat completion."""


class UnusableReplyError(LlmError):
    """The model answered, and never what was asked for. ``replies`` are its texts, first to last."""

    def __init__(self, sentence: str, replies: tuple[str, ...]) -> None:
        super().__init__(sentence)
        self.replies = replies


class CassetteError(LlmError):
    """A recording can't be read, or lacks the question."""
