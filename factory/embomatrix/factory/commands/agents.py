"""``embomatrix factory agent``: each agent of the factory alone, a brief in and its answer out."""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from embomatrix.factory.commands.asked_model import Key, Tape, chat_model
from embomatrix.factory.commands.layout import Llm, Model, mended_layout, modelled_agents
from embomatrix.factory.commands.terminal import fail
from embomatrix.factory.layout.agent_interfaces import LAYOUT_AGENTS, MODEL_BACKED, AgentName
from embomatrix.factory.social.agent_interfaces import SOCIAL_AGENTS, SocialAgent, answer_with_model
from embomatrix.factory.social.model_agents import SocialModelAgents

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from embomatrix.factory.layout.agent_interfaces import AgentInterface

EVERY: Final[Mapping[str, AgentInterface]] = {
    **{name.value: door for name, door in SOCIAL_AGENTS.items()},
    **{name.value: door for name, door in LAYOUT_AGENTS.items()},
}
"""All agents by name, in the order of their work."""


BriefFile = Annotated[
    Path | None, typer.Option("--in", help="File with its brief as JSON; '-' reads standard input.")
]


def agent(
    name: Annotated[str, typer.Argument(help=f"Which agent: {', '.join(EVERY)}.")],
    brief: BriefFile = None,
    schema: Annotated[bool, typer.Option("--schema", help="Print the JSON schema of its brief.")] = False,
    llm: Llm = "",
    model: Model = "",
    key: Key = "",
    cassette: Tape = None,
) -> None:
    """Run one agent alone: a brief in, its answer out, by rules or by a language model."""
    if name not in EVERY:
        fail(f"there is no agent {name!r}: expected one of {', '.join(EVERY)}")
    door = EVERY[name]
    if schema:
        typer.echo(json.dumps(door.brief.json_schema(), indent=1))
        return
    if brief is None:
        fail(
            f"{name}, {door.about}, needs a brief: give --in FILE; `factory lay --out` writes some, `--schema` tells the form"
        )
    with mended_layout():
        value = door.read(sys.stdin.read() if str(brief) == "-" else brief.read_text(encoding="utf-8"))
        modelled = bool(llm) or cassette is not None
        answer = _of_model(name, value, llm, model, key, cassette) if modelled else door.rules(value)
        typer.echo(door.written(answer))


def _of_model(name: str, brief: Any, url: str, model: str, key: str, cassette: Path | None) -> Any:
    """What a language model answers. Raises LlmError."""
    if name in set(SocialAgent):

        async def one() -> Any:
            async with chat_model(url, model, key, cassette) as chat:
                return await answer_with_model(SocialModelAgents(chat), SocialAgent(name), brief)

        return asyncio.run(one())
    if AgentName(name) not in MODEL_BACKED:
        others = ", ".join([*SocialAgent, *sorted(MODEL_BACKED)])
        fail(f"{name} has no form with a language model: leave out --llm; {others} have one")
    with modelled_agents(url, model, key, cassette) as agents:
        answers: dict[AgentName, Callable[[Any], Any]] = {
            AgentName.DISTRIBUTOR: agents.distribute,
            AgentName.ORGANIZER: lambda value: tuple(agents.organize(value).branches()),
            AgentName.PLANNER: agents.choose_constraints,
        }
        return answers[AgentName(name)](brief)
