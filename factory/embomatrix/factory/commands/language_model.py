"""Language models for the factory's commands: options, endpoint, cassette, and the agents that run on them."""

import contextlib
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Annotated, Final

import typer

from embomatrix.factory.commands.terminal import fail
from embomatrix.factory.layout.agent_interfaces import MODEL_BACKED, AgentName, BriefError
from embomatrix.factory.layout.distribution import DistributionError
from embomatrix.factory.layout.model_agents import ModelLayoutAgents
from embomatrix.factory.layout.request import LayoutAgents
from embomatrix.factory.pictures.sights import sights_of
from embomatrix.factory.scenes.build import build_base_scene
from embomatrix.factory.social.model.agents import SocialModelAgents
from embomatrix.factory.social.model.writer import ModelWriter
from embomatrix.llm.batch import FailureLimit
from embomatrix.llm.cassette import Cassette
from embomatrix.llm.endpoint import Endpoint
from embomatrix.llm.ledger import Ledger, Price
from embomatrix.llm.values import ChatModel, EndpointError, LlmError
from embomatrix.rpc.status import ClusterError

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


MODEL_ERRORS: Final = (BriefError, ClusterError, DistributionError, LlmError)
"""Errors of agents, language models and clusters whose message is a sentence for the user."""


def _endpoint(url: str, model: str, key: str) -> Endpoint | None:
    """Return the endpoint, which the caller opens. Raise EndpointError if the URL has no model name."""
    if url and not model:
        raise EndpointError("--llm needs the name of a model at the endpoint: give --model")
    return Endpoint(url, model, api_key=key) if url else None


def _recorded(model: ChatModel | None, cassette: Path | None) -> ChatModel:
    """Return the model with its cassette. Without a model, the cassette replays.

    Raise EndpointError if neither is given. Raise CassetteError if the cassette can't be read.
    """
    if cassette is not None:
        return Cassette(cassette, model)
    if model is None:
        raise EndpointError("no language model is given: add --llm URL and --model NAME, or --cassette FILE")
    return model


@contextlib.asynccontextmanager
async def chat_model(url: str, model: str, key: str, cassette: Path | None) -> AsyncIterator[ChatModel]:
    """Yield an open chat model. Raise EndpointError or CassetteError."""
    endpoint = _endpoint(url, model, key)
    chat = _recorded(endpoint, cassette)
    async with endpoint or contextlib.nullcontext():
        yield chat


@contextlib.contextmanager
def model_layout_agents(
    url: str, model: str, key: str, cassette: Path | None, failure_limit: FailureLimit | None = None
) -> Iterator[ModelLayoutAgents]:
    """Yield layout agents that run on a language model. Raise LlmError."""
    endpoint = _endpoint(url, model, key)
    with ModelLayoutAgents(_recorded(endpoint, cassette), endpoint, failure_limit=failure_limit) as agents:
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
def model_request_writer(
    url: str,
    model: str,
    key: str,
    cassette: Path | None,
    *,
    price: Price,
    accounts: Path,
    look: bool,
    seed: int,
) -> Iterator[tuple[ModelWriter, Ledger]]:
    """Yield a writer of requests on a language model, and the ledger of its costs.

    ``accounts`` is the ledger's file. With ``look``, the model sees pictures of each base scene, built with ``seed``.
    Raise EndpointError or CassetteError.
    """
    endpoint = _endpoint(url, model, key)
    if endpoint is None:
        ledger = Ledger(_recorded(None, cassette))
        chat: ChatModel = ledger
    else:
        # The ledger sits behind the cassette: replayed answers cost nothing.
        ledger = Ledger(endpoint, price=price, path=accounts)
        chat = _recorded(ledger, cassette)

    def sights(base: str) -> tuple[bytes, ...]:
        return sights_of(build_base_scene(base, seed=seed))

    with ModelWriter(SocialModelAgents(chat), endpoint, sights if look else None) as writer:
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
