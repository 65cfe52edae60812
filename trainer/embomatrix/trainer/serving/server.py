"""Client of a model server: plans and new weights, with retries while the server is away.

Requests run on an event loop in their own thread, so that all plans of a step are sampled at once, and the end of a run
cancels what is not finished.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import threading
from collections.abc import Awaitable, Callable, Coroutine
from concurrent.futures import Future
from typing import Any, Final, Self, TypeVar

import httpx
from pydantic import BaseModel

from embomatrix.host.backoff import Backoff
from embomatrix.llm.endpoint import RETRIED
from embomatrix.trainer.config.errors import TrainerError, reason_of
from embomatrix.trainer.config.settings import SamplerSettings
from embomatrix.trainer.serving.forms import (
    FORMS,
    AbortedError,
    AnswerError,
    OldWeightsError,
    PlanRequest,
    ServedPlan,
    ServerCall,
    Weights,
)
from embomatrix.world.json_text import parse_json

logger = logging.getLogger(__name__)
T = TypeVar("T")
CONNECT_S: Final = 10.0
MOST_REQUESTS: Final = 32
"""Requests for plans that the server works on at once. More would only wait there, while their timeout runs."""
FIRST_RETRY_S: Final = 0.5
MAX_RETRY_S: Final = 15.0
"""The wait between two attempts doubles from ``FIRST_RETRY_S`` up to this value."""
QUOTED: Final = 120
"""Characters of the server's answer that an error quotes."""
GOODBYE_S: Final = 5.0
"""Seconds that the last request of a run may take."""


class _AwayError(Exception):
    """Failure that a later attempt may not have: no connection, or a status in ``RETRIED``."""

    def __init__(self, found: str, remedy: str) -> None:
        super().__init__(found)
        self.remedy = remedy


class _RefusedError(Exception):
    """The server refused a request."""


class ServedModel(BaseModel):
    """Entry of the server's list of models. ``max_model_len``: the longest prompt and plan together in tokens."""

    id: str
    max_model_len: int | None = None
    parent: str | None = None
    """Base model of adapters."""


class _ModelList(BaseModel):
    data: list[ServedModel]


def served_models(answer: bytes) -> list[ServedModel]:
    """Return the models in the answer of ``/v1/models``. Raises ValueError for any other text."""
    return _ModelList.model_validate(parse_json(answer)).data


class ModelServer:
    """Context manager over one server. All methods are called from the trainer's thread. ``key`` is the server's API key.

    Raises TrainerError if the address is not valid.
    """

    def __init__(self, settings: SamplerSettings, *, key: str = "") -> None:
        self.url = settings.url
        self._settings = settings
        self.form = FORMS[settings.kind]
        self._weights: Weights | None = None
        self._restoring = asyncio.Lock()
        self._gate = asyncio.Semaphore(MOST_REQUESTS)
        try:
            self._http = httpx.AsyncClient(
                base_url=settings.url,
                headers={"authorization": f"Bearer {key}"} if key else {},
                timeout=httpx.Timeout(settings.timeout_s, connect=CONNECT_S),
            )
        except httpx.InvalidURL as error:
            raise TrainerError(
                f"sampler.url {settings.url!r} is not an address ({error}): expected http://HOST:PORT"
            ) from error
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="model-server", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._start(self._close()).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _close(self) -> None:
        own = asyncio.current_task()
        pending = [task for task in asyncio.all_tasks() if task is not own]
        for task in pending:
            task.cancel()
        await asyncio.gather(*pending, return_exceptions=True)
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(GOODBYE_S):
                await self._unload()
        await self._http.aclose()

    def _start(self, work: Coroutine[Any, Any, T]) -> Future[T]:
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def models(self) -> list[ServedModel]:
        """Return the served models, without retries. Raises TrainerError."""
        return self._start(self._persist(self._models, retry_s=0)).result()

    def load(self, weights: Weights) -> None:
        """Replace the weights from which the server samples. Raises TrainerError."""
        self._start(self._persist(lambda: self._replace(weights), retry_s=self._settings.retry_s)).result()

    def load_once(self, weights: Weights) -> None:
        """Do the same without retries, before the run begins."""
        self._start(self._persist(lambda: self._replace(weights), retry_s=0)).result()

    def plans(self, request: PlanRequest) -> Future[list[ServedPlan]]:
        """Begin to sample. The result has the order of the prompts; it raises TrainerError."""
        return self._start(self._persist(lambda: self._sample(request), retry_s=self._settings.retry_s))

    async def _persist(self, work: Callable[[], Awaitable[T]], *, retry_s: float) -> T:
        """Do the work, and repeat it for ``retry_s`` seconds while the server is away."""
        until_s = self._loop.time() + retry_s
        backoff = Backoff(FIRST_RETRY_S, MAX_RETRY_S)
        while True:
            try:
                return await work()
            except (_AwayError, AbortedError) as error:
                wait_s = backoff.next_s()
                if self._loop.time() + wait_s > until_s:
                    raise TrainerError(f"the model server {self.url}: {_farewell(error, retry_s)}") from error
                logger.warning("model server failed, retrying url=%s: %s", self.url, error)
            except (_RefusedError, OldWeightsError, AnswerError) as error:
                raise TrainerError(
                    f"the model server {self.url}: {error}: {_REMEDIES[type(error)]}"
                ) from error
            await asyncio.sleep(wait_s)

    async def _sample(self, request: PlanRequest) -> list[ServedPlan]:
        weights = self._weights
        if weights is None:
            raise AssertionError("weights are loaded before plans are sampled")
        try:
            return await self._draw(request, weights)
        except (_RefusedError, OldWeightsError) as error:
            logger.warning("model server may have lost its weights url=%s: %s", self.url, error)
            await self._restore(weights)
        return await self._draw(request, weights)

    async def _draw(self, request: PlanRequest, weights: Weights) -> list[ServedPlan]:
        async with self._gate:
            answer = await self._post(self.form.sampling(request, weights))
        return self.form.plans(answer, request, weights)

    async def _restore(self, weights: Weights) -> None:
        """Load the weights into a server that was restarted, once for all waiting requests."""
        async with self._restoring:
            if not await self._holds(weights):
                await self._post(self.form.loading(weights))

    async def _holds(self, weights: Weights) -> bool:
        """True if the server lists the adapters. Whole models are not listed."""
        return weights.are_adapters and weights.name in {model.id for model in await self._models()}

    async def _replace(self, weights: Weights) -> None:
        if self._weights != weights:
            await self._unload()
            self._weights = weights
        # An attempt whose answer was lost may have loaded them.
        if not await self._holds(weights):
            await self._post(self.form.loading(weights))

    async def _unload(self) -> None:
        """Remove the present weights. A failure is harmless: the server keeps adapters that nothing uses."""
        call = None if self._weights is None else self.form.unloading(self._weights)
        if call is not None:
            with contextlib.suppress(_AwayError, _RefusedError):
                await self._post(call)

    async def _models(self) -> list[ServedModel]:
        answer = await self._request("GET", "/v1/models")
        try:
            return served_models(answer)
        except ValueError as error:
            raise AnswerError("its answer is not a list of models") from error

    async def _post(self, call: ServerCall) -> bytes:
        return await self._request("POST", call.path, call.body)

    async def _request(self, method: str, path: str, body: object = None) -> bytes:
        try:
            response = await self._http.request(method, path, json=body)
        except httpx.TimeoutException as error:
            raise _AwayError(f"it gave no answer within {self._settings.timeout_s:g} s", _SEE_LOG) from error
        except httpx.HTTPError as error:
            raise _AwayError(f"it can't be reached ({reason_of(error)})", _START) from error
        if response.status_code == httpx.codes.OK:
            return response.content
        found = f"it answered {response.status_code} to {path} ({_quoted(response.text)})"
        if response.status_code in RETRIED:
            raise _AwayError(found, _SEE_LOG)
        raise _RefusedError(found)


def _farewell(error: _AwayError | AbortedError, retry_s: float) -> str:
    """Return the reason and the remedy after the last attempt."""
    if retry_s:
        return f"{error}, for {retry_s:g} s: start it again, and continue with --resume; nothing that was learnt is lost"
    return f"{error}: {error.remedy if isinstance(error, _AwayError) else _SEE_LOG}"


_SEE_LOG: Final = "see the server's log"
_START: Final = "start it first, or correct sampler.url"
_REMEDIES: Final[dict[type[Exception], str]] = {
    _RefusedError: "check sampler.url, sampler.kind and the server's options",
    OldWeightsError: "give this run a server of its own, into which no other program loads weights",
    AnswerError: "serve the model with vLLM or SGLang, and set sampler.kind to which of them it is",
}


def _quoted(text: str) -> str:
    line = " ".join(text.split())
    return f"{line[:QUOTED]}…" if len(line) > QUOTED else line or "no text"
