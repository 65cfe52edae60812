"""Ledger of model use by purpose: calls, tokens, seconds and money."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from embomatrix.llm.values import ChatModel, ChatRequest, LlmError, Reply

MILLION = 1_000_000


@dataclass(frozen=True, slots=True)
class Price:
    """Price of a million tokens, in any currency."""

    prompt: float = 0.0
    completion: float = 0.0


@dataclass(slots=True)
class Account:
    """Sums of one purpose. ``failed`` counts questions without any answer."""

    calls: int = 0
    failed: int = 0
    retries: int = 0
    prompt_tokens: int = 0
    completion_tokens: int = 0
    seconds: float = 0.0
    cost: float = 0.0


class Ledger:
    """Model that records the cost of every call. Each call is also a line of ``path``, if one is given."""

    def __init__(self, model: ChatModel, *, price: Price | None = None, path: Path | None = None) -> None:
        self._model = model
        self._price = price or Price()
        self._path = path
        self.accounts: dict[str, Account] = {}

    async def complete(self, request: ChatRequest) -> Reply:
        """Ask the model and record the cost."""
        account = self.accounts.setdefault(request.purpose, Account())
        try:
            reply = await self._model.complete(request)
        except LlmError as error:
            account.failed += 1
            self._write({"purpose": request.purpose, "failed": str(error)})
            raise
        cost = self._cost(reply)
        account.calls += 1
        account.retries += reply.retries
        account.prompt_tokens += reply.usage.prompt_tokens
        account.completion_tokens += reply.usage.completion_tokens
        account.seconds += reply.seconds
        account.cost += cost
        self._write(
            {
                "purpose": request.purpose,
                "model": reply.model,
                "prompt_tokens": reply.usage.prompt_tokens,
                "completion_tokens": reply.usage.completion_tokens,
                "seconds": round(reply.seconds, 3),
                "retries": reply.retries,
                "cost": round(cost, 6),
            }
        )
        return reply

    def total(self) -> Account:
        """Sum of all purposes."""
        sums = Account()
        for account in self.accounts.values():
            for name in Account.__dataclass_fields__:
                setattr(sums, name, getattr(sums, name) + getattr(account, name))
        return sums

    def _cost(self, reply: Reply) -> float:
        prompt = reply.usage.prompt_tokens * self._price.prompt
        return (prompt + reply.usage.completion_tokens * self._price.completion) / MILLION

    def _write(self, line: Mapping[str, object]) -> None:
        if self._path is not None:
            append_line(self._path, line)


def append_line(path: Path, value: Mapping[str, object]) -> None:
    """Append a JSON value to a file as one line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(value, ensure_ascii=False) + "\n")
