"""What a language model cost: calls, tokens, seconds and money, by purpose."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.llm.values import LlmError

if TYPE_CHECKING:
    from pathlib import Path

    from embomatrix.llm.values import ChatModel, ChatRequest, Reply

MILLION = 1_000_000


@dataclass(frozen=True, slots=True)
class Price:
    """Of a million tokens, in any one currency."""

    prompt: float = 0.0
    completion: float = 0.0


@dataclass(slots=True)
class Account:
    """Sums of one purpose. ``failed`` questions got no answer at all."""

    calls: int = 0
    failed: int = 0
    retries: int = 0
    prompt_tokens: int = 0
    completion_tokens: int = 0
    seconds: float = 0.0
    cost: float = 0.0


class Ledger:
    """A model that keeps accounts of what it is asked; every call is also a line of ``path``, where one is given."""

    def __init__(self, model: ChatModel, *, price: Price | None = None, path: Path | None = None) -> None:
        self._model = model
        self._price = price or Price()
        self._path = path
        self.accounts: dict[str, Account] = {}

    async def complete(self, request: ChatRequest) -> Reply:
        """Ask, and write down what it cost."""
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
        """All purposes together."""
        sums = Account()
        for account in self.accounts.values():
            for name in Account.__dataclass_fields__:
                setattr(sums, name, getattr(sums, name) + getattr(account, name))
        return sums

    def _cost(self, reply: Reply) -> float:
        prompt = reply.usage.prompt_tokens * self._price.prompt
        return (prompt + reply.usage.completion_tokens * self._price.completion) / MILLION

    def _write(self, line: dict[str, object]) -> None:
        if self._path is None:
            return
        self._path.parent.mkdir(parents=True, exist_ok=True)
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, ensure_ascii=False) + "\n")
