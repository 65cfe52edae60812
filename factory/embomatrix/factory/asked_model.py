"""From options of a command to a language model: an endpoint, a recording of one, or both."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

from embomatrix.llm.cassette import Cassette, CassetteMode
from embomatrix.llm.endpoint import Endpoint
from embomatrix.llm.values import EndpointError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from embomatrix.llm.values import ChatModel


@contextlib.asynccontextmanager
async def chat_model(url: str, model: str, key: str, cassette: Path | None) -> AsyncIterator[ChatModel]:
    """Whom to ask. Without a ``url`` only the cassette answers, without a cassette nothing is recorded.

    Raises EndpointError where neither is given, or a ``url`` without the name of a model; CassetteError.
    """
    if url and not model:
        raise EndpointError("--llm needs the name of a model there: give --model")
    async with contextlib.AsyncExitStack() as stack:
        endpoint = await stack.enter_async_context(Endpoint(url, model, api_key=key)) if url else None
        if cassette is not None:
            yield Cassette(cassette, CassetteMode.AUTO if endpoint else CassetteMode.REPLAY, endpoint)
        elif endpoint is not None:
            yield endpoint
        else:
            raise EndpointError(
                "a language model is to be asked: give --llm URL and --model NAME, or --cassette FILE"
            )
