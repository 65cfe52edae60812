"""Language models for the factory's commands: options, endpoint, cassette, and the agents that run on them."""

import contextlib
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.terminal import fail
from embomatrix.factory.layout.agent_interfaces import MODEL_BACKED, AgentName
from embomatrix.factory.layout.model_agents import ModelLayoutAgents
from embomatrix.factory.layout.request import LayoutAgents
from embomatrix.factory.pictures.sights import sights_of
from embomatrix.factory.social.model_agents import SocialModelAgents
from embomatrix.factory.social.model_writer import ModelWriter
from embomatrix.llm.batch import FailureLimit
from embomatrix.llm.cassette import Cassette
from embomatrix.llm.endpoint import Endpoint
from embomatrix.llm.ledger import Ledger, Price
from embomatrix.llm.values import ChatModel, EndpointError

Forms = Annotated[
    list[str] | None,
    typer.Option("--agent", help="Layout agent, NAME=llm or NAME=rules. Repeat the option for more agents."),
]
Llm = Annotated[
    str, typer.Option(help="Base URL of an OpenAI-compatible endpoint for agents that are language models.")
]
Model = Annotated[str, typer.Option(help="Name of the model at the endpoint.")]
Key = Annotated[str, typer.Option("--llm-key", envvar="EMBOMATRIX_LLM_KEY", help="API key of the endpoint.")]
Tape = Annotated[
    Path | None,
    typer.Option(
        "--cassette", help="File with recorded answers. Missing answers are requested and appended."
    ),
]


def _chat_model(url: str, model: str, key: str, cassette: Path | None) -> tuple[ChatModel, Endpoint | None]:
    """Return the chat model and its endpoint, which the caller opens.

    Without a URL, the cassette replays. Raise EndpointError if neither is given, or if the URL has no model name.
    Raise CassetteError if the cassette can't be read.
    """
    if url and not model:
        raise EndpointError("--llm needs the name of a model at the endpoint: give --model")
    endpoint = Endpoint(url, model, api_key=key) if url else None
    if cassette is not None:
        return Cassette(cassette, endpoint), endpoint
    if endpoint is None:
        raise EndpointError("no language model is given: add --llm URL and --model NAME, or --cassette FILE")
    return endpoint, endpoint


@contextlib.asynccontextmanager
async def chat_model(url: str, model: str, key: str, cassette: Path | None) -> AsyncIterator[ChatModel]:
    """Yield an open chat model. Raise EndpointError or CassetteError."""
    chat, endpoint = _chat_model(url, model, key, cassette)
    async with endpoint or contextlib.nullcontext():
        yield chat


@contextlib.contextmanager
def model_layout_agents(
    url: str, model: str, key: str, cassette: Path | None, failure_limit: FailureLimit | None = None
) -> Iterator[ModelLayoutAgents]:
    """Yield layout agents that run on a language model. Raise LlmError."""
    chat, endpoint = _chat_model(url, model, key, cassette)
    with ModelLayoutAgents(chat, endpoint, failure_limit=failure_limit) as agents:
        yield agents


@contextlib.contextmanager
def layout_agents(
    names: frozenset[AgentName],
    url: str,
    model: str,
    key: str,
    cassette: Path | None,
    failure_limit: FailureLimit | None = None,
) -> Iterator[LayoutAgents | None]:
    """Yield layout agents with the named ones on a language model; None if all follow rules. Raise LlmError."""
    if not names:
        yield None
        return
    with model_layout_agents(url, model, key, cassette, failure_limit) as agents:
        yield agents.agents(names)


@contextlib.contextmanager
def model_task_writer(
    url: str, model: str, key: str, cassette: Path | None, *, price: Price, accounts: Path, look: bool
) -> Iterator[tuple[ModelWriter, Ledger]]:
    """Yield a task writer on a language model, and the ledger of its costs.

    ``accounts`` is the ledger's file. With ``look``, the model sees pictures of each scene. Raise CassetteError.
    """
    endpoint = Endpoint(url, model, api_key=key) if url else None
    if endpoint is None:
        if cassette is None:
            raise ValueError("found neither an endpoint nor a cassette: expected one of them")
        chat: ChatModel = Cassette(cassette)
        ledger = chat = Ledger(chat)
    else:
        # The ledger sits behind the cassette: replayed answers cost nothing.
        ledger = Ledger(endpoint, price=price, path=accounts)
        chat = ledger if cassette is None else Cassette(cassette, ledger)
    with ModelWriter(SocialModelAgents(chat), endpoint, sights_of if look else None) as writer:
        yield writer, ledger


def model_backed_agents(forms: list[str] | None) -> frozenset[AgentName]:
    """Return the agents that ``--agent NAME=llm`` options select."""
    found = set()
    for form in forms or ():
        name, _, kind = form.partition("=")
        if name not in set(AgentName) or kind not in ("llm", "rules"):
            fail(f"--agent {form!r}: expected NAME=llm or NAME=rules with NAME one of {', '.join(AgentName)}")
        if kind == "llm":
            if AgentName(name) not in MODEL_BACKED:
                fail(f"{name} can't be a language model: expected one of {', '.join(sorted(MODEL_BACKED))}")
            found.add(AgentName(name))
    return frozenset(found)
