"""``embomatrix factory agent``: run one agent of the factory on a brief."""

import asyncio
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from embomatrix.factory.commands.language_model import (
    MODEL_ERRORS,
    Key,
    Llm,
    Model,
    Tape,
    chat_model,
    model_layout_agents,
)
from embomatrix.factory.commands.terminal import fail, say, user_errors
from embomatrix.factory.days.agent_interfaces import SOCIAL_AGENTS, SocialAgent, answer_with_model
from embomatrix.factory.layout.agent_interfaces import LAYOUT_AGENTS, MODEL_BACKED, AgentInterface, AgentName
from embomatrix.factory.social.model.agents import SocialModelAgents

ALL_AGENTS: Final[Mapping[str, AgentInterface]] = {
    name.value: interface for name, interface in (*SOCIAL_AGENTS.items(), *LAYOUT_AGENTS.items())
}
"""Interfaces of all agents by name, in the order in which the pipeline calls them."""


BriefFile = Annotated[
    Path | None, typer.Option("--in", help="File with the agent's brief as JSON; '-' reads standard input.")
]


def agent(
    name: Annotated[str, typer.Argument(help=f"Name of the agent: {', '.join(ALL_AGENTS)}.")],
    brief: BriefFile = None,
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON schema of the brief.")] = False,
    llm: Llm = "",
    model: Model = "",
    key: Key = "",
    cassette: Tape = None,
) -> None:
    """Run one agent on a brief, by rules or with a language model, and print its answer."""
    if name not in ALL_AGENTS:
        fail(f"there is no agent {name!r}: expected one of {', '.join(ALL_AGENTS)}")
    interface = ALL_AGENTS[name]
    if schema:
        typer.echo(json.dumps(interface.brief.json_schema(), indent=1))
        return
    if brief is None:
        fail(
            f"{name} ({interface.about}) needs a brief: give --in FILE; `factory lay --out` writes briefs, "
            "`--schema` prints their schema"
        )
    with user_errors(more=MODEL_ERRORS):
        value = interface.read(sys.stdin.read() if str(brief) == "-" else brief.read_text(encoding="utf-8"))
        use_model = bool(llm) or cassette is not None
        answer = _ask_model(name, value, llm, model, key, cassette) if use_model else interface.rules(value)
        say(interface.to_json(answer))


def _ask_model(name: str, brief: Any, url: str, model: str, key: str, cassette: Path | None) -> Any:
    """Return the answer of a language model. Raise LlmError."""
    if name in set(SocialAgent):

        async def ask() -> Any:
            async with chat_model(url, model, key, cassette) as chat:
                return await answer_with_model(SocialModelAgents(chat), SocialAgent(name), brief)

        return asyncio.run(ask())
    if AgentName(name) not in MODEL_BACKED:
        others = ", ".join([*SocialAgent, *sorted(MODEL_BACKED)])
        fail(f"{name} can't be a language model: leave out --llm, or choose one of {others}")
    with model_layout_agents(url, model, key, cassette) as agents:
        match AgentName(name):
            case AgentName.DISTRIBUTOR:
                return agents.distribute(brief)
            case AgentName.ORGANIZER:
                return tuple(agents.organize(brief).branches())
            case _:
                return agents.choose_constraints(brief)
