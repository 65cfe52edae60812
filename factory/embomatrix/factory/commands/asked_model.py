"""From options of a command to a language model: an endpoint, a recording of one, or both."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from embomatrix.llm.cassette import Cassette, CassetteMode
from embomatrix.llm.endpoint import Endpoint
from embomatrix.llm.values import EndpointError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from embomatrix.llm.values import ChatModel

Key = Annotated[str, typer.Option("--llm-key", envvar="EMBOMATRIX_LLM_KEY", help="Its key.")]
Tape = Annotated[
    Path | None,
    typer.Option("--cassette", help="Recorded answers: read where it has them, added to where not."),
]


def model_asked(url: str, model: str, key: str, cassette: Path | None) -> tuple[ChatModel, Endpoint | None]:
    """Whom to ask, and the endpoint behind it, which is to be opened. Without a ``url`` only the cassette answers, without a
    cassette nothing is recorded.

    Raises EndpointError where neither is given, or a ``url`` without the name of a model; CassetteError.
    """
    if url and not model:
        raise EndpointError("--llm needs the name of a model there: give --model")
    endpoint = Endpoint(url, model, api_key=key) if url else None
    if cassette is not None:
        return Cassette(cassette, CassetteMode.AUTO if endpoint else CassetteMode.REPLAY, endpoint), endpoint
    if endpoint is None:
        raise EndpointError(
            "a language model is to be asked: give --llm URL and --model NAME, or --cassette FILE"
        )
    return endpoint, endpoint


@contextlib.asynccontextmanager
async def chat_model(url: str, model: str, key: str, cassette: Path | None) -> AsyncIterator[ChatModel]:
    """`model_asked`, open for as long as this is held."""
    asked, endpoint = model_asked(url, model, key, cassette)
    async with endpoint or contextlib.nullcontext():
        yield asked
