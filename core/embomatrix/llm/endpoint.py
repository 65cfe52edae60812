"""Client of OpenAI-compatible endpoints with bounded retries, bounded concurrency, and errors that name the remedy.

It uses the subset of the chat completions API that hosted services, vLLM, SGLang, llama.cpp and Ollama share.
"""

from __future__ import annotations

import asyncio
import base64
import json
import logging
import random
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Self

import httpx

from embomatrix.host.backoff import Backoff
from embomatrix.llm.values import ChatRequest, EndpointError, Message, Reply, Usage

logger = logging.getLogger(__name__)

RETRIED: Final = frozenset({408, 425, 429, 500, 502, 503, 504})
"""Statuses that are worth a retry."""
NO_SCHEMAS: Final = frozenset({400, 415, 422, 501})
"""Statuses of endpoints that take no ``response_format``."""
MAX_REPLY_BYTES: Final = 8 * 1024 * 1024
MAX_RETRY_AFTER_S: Final = 60.0
MOST_TOKENS: Final = 10**9
"""Larger counts of tokens are no counts. They would overflow the sum of costs."""
QUOTED: Final = 300
"""Characters of the endpoint's answer that an error quotes."""


@dataclass(frozen=True, slots=True)
class EndpointLimits:
    """Bounds of one question. Waits double from ``first_wait_s`` to ``longest_wait_s``, with jitter in their upper half."""

    attempts: int = 6
    timeout_s: float = 120.0
    """Timeout of one attempt."""
    deadline_s: float = 600.0
    """Deadline of all attempts together."""
    first_wait_s: float = 0.5
    longest_wait_s: float = 30.0
    concurrent: int = 8


class Endpoint:
    """Async context manager over one endpoint. ``base_url`` is the part before ``/chat/completions``.

    The JSON schema of an answer is sent as ``response_format``, so that the endpoint constrains the answer. With
    ``constrain=False``, or after the endpoint refused a schema, the prompt quotes the schema instead. ``jitter``
    randomises the waits, so that calls that failed together are not retried together.
    """

    def __init__(
        self,
        base_url: str,
        model: str,
        *,
        api_key: str = "",
        limits: EndpointLimits | None = None,
        jitter: random.Random | None = None,
        constrain: bool = True,
    ) -> None:
        self.model = model
        self.constrain = constrain
        self._url = f"{base_url.rstrip('/')}/chat/completions"
        self._limits = limits or EndpointLimits()
        self._jitter = jitter or random.Random()
        self._gate = asyncio.Semaphore(self._limits.concurrent)
        headers = {"authorization": f"Bearer {api_key}"} if api_key else {}
        self._http = httpx.AsyncClient(headers=headers, timeout=self._limits.timeout_s)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._http.aclose()

    async def complete(self, request: ChatRequest) -> Reply:
        """Ask, and retry where that may help. Raises EndpointError."""
        constrain = self.constrain and request.json_schema is not None
        backoff = Backoff(
            self._limits.first_wait_s, self._limits.longest_wait_s, lambda: self._jitter.uniform(0.5, 1.0)
        )
        async with self._gate:
            began_s = time.monotonic()
            for attempt in range(self._limits.attempts):
                found = await self._attempt(self._body(request, constrain))
                if not isinstance(found, _Failure):
                    self._learn(request, constrain)
                    return _reply(found, self.model, time.monotonic() - began_s, attempt)
                if constrain and found.status in NO_SCHEMAS and attempt + 1 < self._limits.attempts:
                    constrain = False
                    continue
                wait_s = backoff.next_s()
                if found.retry_after_s is not None:
                    wait_s = min(found.retry_after_s, MAX_RETRY_AFTER_S)
                elapsed_s = time.monotonic() - began_s
                last = attempt + 1 == self._limits.attempts or elapsed_s + wait_s > self._limits.deadline_s
                if not found.transient or last:
                    raise EndpointError(self._sentence(request, found, attempt + 1), found.status)
                await asyncio.sleep(wait_s)
        raise AssertionError("the last attempt returns or raises")

    def _learn(self, request: ChatRequest, constrained: bool) -> None:
        """Send no more schemas to an endpoint that answered only without one."""
        if self.constrain and not constrained and request.json_schema is not None:
            logger.warning("%s takes no JSON schema of an answer: prompts quote it from now on", self._url)
            self.constrain = False

    def _body(self, request: ChatRequest, constrain: bool) -> dict[str, Any]:
        messages = request.messages
        if request.json_schema is not None and not constrain:
            messages = _with_schema(messages, request.json_schema)
        body: dict[str, Any] = {
            "model": self.model,
            "messages": [_message(message) for message in messages],
            "max_tokens": request.max_tokens,
            "temperature": request.temperature,
        }
        if request.seed is not None:
            body["seed"] = request.seed
        if constrain:
            name = re.sub(r"\W+", "_", request.purpose)
            form = {"name": name, "schema": request.json_schema}
            body["response_format"] = {"type": "json_schema", "json_schema": form}
        return body

    async def _attempt(self, body: dict[str, Any]) -> dict[str, Any] | _Failure:
        try:
            # httpx's own timeouts start anew with each byte.
            async with (
                asyncio.timeout(self._limits.timeout_s),
                self._http.stream("POST", self._url, json=body) as response,
            ):
                data = bytearray()
                async for part in response.aiter_bytes():
                    data += part
                    if len(data) > MAX_REPLY_BYTES:
                        return _Failure(
                            f"it answered with more than {MAX_REPLY_BYTES} bytes", transient=False
                        )
        except (httpx.TimeoutException, TimeoutError):
            return _Failure(f"it gave no answer within {self._limits.timeout_s:g} s", transient=True)
        except (httpx.RequestError, httpx.StreamError) as error:
            return _Failure(f"it can't be reached ({error or type(error).__name__})", transient=True)
        except httpx.InvalidURL as error:
            return _Failure(f"this is not a valid address ({error})", transient=False)
        return _judged(response, bytes(data))

    def _sentence(self, request: ChatRequest, failure: _Failure, attempts: int) -> str:
        tries = "" if attempts == 1 else f", {attempts} times"
        return f"{request.purpose}: the endpoint {self._url}: {failure.found}{tries}: {failure.remedy}"


@dataclass(frozen=True, slots=True)
class _Failure:
    found: str
    transient: bool
    retry_after_s: float | None = None
    remedy: str = "check its address, its model's name and its key"
    status: int = 0


def _judged(response: httpx.Response, data: bytes) -> dict[str, Any] | _Failure:
    if response.status_code in RETRIED:
        return _Failure(
            f"it answered {response.status_code} ({_quoted(data)})",
            transient=True,
            retry_after_s=_retry_after(response),
            remedy="it is overloaded or broken: try again later",
        )
    if response.status_code != httpx.codes.OK:
        return _Failure(
            f"it answered {response.status_code} ({_quoted(data)})",
            transient=False,
            status=response.status_code,
        )
    try:
        value: dict[str, Any] = json.loads(data)
        if isinstance(value["choices"][0]["message"], dict):
            return value
    except (ValueError, KeyError, IndexError, TypeError, RecursionError):
        pass
    # A proxy that is starting up may send anything with status 200.
    return _Failure(f"its answer is not a chat completion ({_quoted(data)})", transient=True)


def _retry_after(response: httpx.Response) -> float | None:
    try:
        return max(0.0, float(response.headers["retry-after"]))
    except (KeyError, ValueError):
        return None


def _quoted(data: bytes) -> str:
    text = " ".join(data.decode("utf-8", errors="replace").split())
    return f"{text[:QUOTED]}…" if len(text) > QUOTED else text or "no text"


def _with_schema(messages: tuple[Message, ...], schema: Mapping[str, Any]) -> tuple[Message, ...]:
    """Return the messages with the schema quoted at the end of the first one."""
    first, *others = messages
    quoted = f"{first.text}\nThe answer is JSON of this schema: {json.dumps(schema, separators=(',', ':'))}"
    return (replace(first, text=quoted), *others)


def _message(message: Message) -> dict[str, Any]:
    if not message.images:
        return {"role": message.speaker.value, "content": message.text}
    parts: list[dict[str, Any]] = [{"type": "text", "text": message.text}]
    for image in message.images:
        url = f"data:image/png;base64,{base64.b64encode(image).decode()}"
        parts.append({"type": "image_url", "image_url": {"url": url}})
    return {"role": message.speaker.value, "content": parts}


def _reply(value: dict[str, Any], model: str, seconds: float, retries: int) -> Reply:
    choice = value["choices"][0]
    content = choice["message"].get("content")
    usage = value.get("usage")
    counts = usage if isinstance(usage, dict) else {}
    return Reply(
        text=_sound(content) if isinstance(content, str) else "",
        model=_sound(str(value.get("model") or model)),
        usage=Usage(_count(counts.get("prompt_tokens")), _count(counts.get("completion_tokens"))),
        finish=_sound(str(choice.get("finish_reason") or "")),
        seconds=seconds,
        retries=retries,
    )


def _sound(text: str) -> str:
    """Return the text with ``?`` for each half of a surrogate pair, which a model may emit and no file can hold."""
    return text.encode("utf-8", "replace").decode("utf-8")


def _count(value: object) -> int:
    return value if isinstance(value, int) and 0 <= value <= MOST_TOKENS else 0
