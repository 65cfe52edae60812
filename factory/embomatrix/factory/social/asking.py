"""From options to a writer behind a language model: endpoint, recording, accounts."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TYPE_CHECKING

from embomatrix.factory.pictures.sights import sights_of
from embomatrix.factory.social.model_agents import SocialModelAgents
from embomatrix.factory.social.model_writer import ModelWriter
from embomatrix.llm.cassette import Cassette, CassetteMode
from embomatrix.llm.endpoint import Endpoint
from embomatrix.llm.ledger import Ledger, Price

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from embomatrix.llm.values import ChatModel


@dataclass(frozen=True, slots=True)
class ModelSource:
    """Whom to ask. Without a ``url`` only the cassette answers; without a cassette nothing is recorded.

    ``looks`` tells that it is shown pictures of the scenes.
    """

    url: str
    model: str
    key: str
    cassette: Path | None
    price: Price
    accounts: Path
    looks: bool = False


@contextlib.contextmanager
def asked_writer(asked: ModelSource) -> Iterator[tuple[ModelWriter, Ledger]]:
    """A writer and what it costs. Raises CassetteError where only a cassette is given and it can't be read."""
    look = sights_of if asked.looks else None
    if not asked.url:
        if asked.cassette is None:
            raise ValueError("neither an endpoint nor a cassette is given: nobody can be asked")
        tape = Cassette(asked.cassette, CassetteMode.REPLAY)
        ledger = Ledger(tape)
        with ModelWriter(SocialModelAgents(ledger), look=look) as writer:
            yield writer, ledger
        return
    endpoint = Endpoint(asked.url, asked.model, api_key=asked.key)
    # Accounts are kept of what is really asked: answers of a recording cost nothing.
    ledger = Ledger(endpoint, price=asked.price, path=asked.accounts)
    model: ChatModel = (
        ledger if asked.cassette is None else Cassette(asked.cassette, CassetteMode.AUTO, ledger)
    )
    with ModelWriter(SocialModelAgents(model), endpoint, look) as writer:
        yield writer, ledger
