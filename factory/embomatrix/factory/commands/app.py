"""``embomatrix factory``: build, generate, list and export datasets of verified tasks."""

import contextlib
from dataclasses import astuple
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from embomatrix.factory.commands.agents import agent
from embomatrix.factory.commands.assets import app as assets_app
from embomatrix.factory.commands.build import make_dataset
from embomatrix.factory.commands.conversations import conversations_
from embomatrix.factory.commands.corpus import corpus
from embomatrix.factory.commands.datasets import export, list_, prompts
from embomatrix.factory.commands.difficulty import difficulty
from embomatrix.factory.commands.evaluate import evaluate
from embomatrix.factory.commands.faithfulness import audit
from embomatrix.factory.commands.inspection import inspect, pictures
from embomatrix.factory.commands.language_model import (
    MODEL_ERRORS,
    Forms,
    Key,
    Llm,
    Model,
    Tape,
    layout_agents,
    model_backed_agents,
    model_request_writer,
)
from embomatrix.factory.commands.layout import lay
from embomatrix.factory.commands.merge import merge
from embomatrix.factory.commands.options import ArmReachability, Jobs, Physical, Scenes, Seed, in_physics
from embomatrix.factory.commands.search import search
from embomatrix.factory.commands.starter import starter
from embomatrix.factory.commands.task_import import import_
from embomatrix.factory.commands.terminal import fail, say, show_table, user_errors
from embomatrix.factory.commands.trial import try_
from embomatrix.factory.commands.verification import verify
from embomatrix.factory.days.maker import DAYS, days_planned_by
from embomatrix.factory.days.model_days import ModelDays
from embomatrix.factory.days.planning import plan_day
from embomatrix.factory.pipeline.build import VariantCheck
from embomatrix.factory.pipeline.cluster import cluster_check
from embomatrix.factory.pipeline.settings import (
    DEFAULT_SCENES,
    SCENE_EXTRACTOR,
    BuildSettings,
    WriterKind,
)
from embomatrix.factory.scenes.base_scenes import base_scenes
from embomatrix.host.commands import command_group
from embomatrix.llm.batch import FailureLimit
from embomatrix.llm.ledger import Ledger, Price
from embomatrix.rpc.options import Ca, Token
from embomatrix.starter.options import DatasetCommand

app = command_group(help="Build and inspect datasets of verified tasks.")
app.add_typer(assets_app, name="assets")
app.command("import")(import_)
app.command("list", cls=DatasetCommand)(list_)
app.command("try")(try_)
app.command("conversations", cls=DatasetCommand)(conversations_)
for command in (agent, lay, inspect, corpus, starter, merge, evaluate):
    app.command()(command)
for reader in (pictures, verify, audit, difficulty, search, prompts, export):
    app.command(cls=DatasetCommand)(reader)

Out = Annotated[Path, typer.Option(help="Folder for the dataset.")]
SocialLlm = Annotated[
    str,
    typer.Option(
        help="Base URL of an OpenAI-compatible endpoint for the social agents, such as http://127.0.0.1:8000/v1."
    ),
]
PriceOfTokens = Annotated[
    tuple[float, float], typer.Option(help="Price of a million input and output tokens, for the cost report.")
]
ManagerAt = Annotated[
    str, typer.Option(help="HOST:PORT of a manager. The oracle's plans are also executed on its cluster.")
]
Look = Annotated[
    bool,
    typer.Option("--look", help="Show the model a plan and views of each scene. Needs a vision model."),
]


@app.command()
def build(
    out: Out,
    train: Annotated[int, typer.Option(min=0, help="Number of training tasks.")] = 480,
    heldout: Annotated[int, typer.Option(min=0, help="Number of evaluation tasks, in other rooms.")] = 40,
    seed: Seed = 0,
    scenes: Scenes = None,
    jobs: Jobs = None,
    reachability: ArmReachability = True,
    physical: Physical = None,
    forms: Forms = None,
    llm: Llm = "",
    model: Model = "",
    key: Key = "",
    cassette: Tape = None,
) -> None:
    """Write tasks over base scenes, keep those that the oracle solves, and save them with their scenes."""
    model_backed = model_backed_agents(forms)
    if (llm or cassette) and not model_backed:
        fail(
            "--llm and --cassette apply to layout agents here: select some, as in --agent room-organizer=llm"
        )
    with (
        user_errors(out, more=MODEL_ERRORS),
        layout_agents(model_backed, llm, model, key, cassette, FailureLimit()) as layout,
    ):
        chosen = base_scenes(scenes or DEFAULT_SCENES)
        settings = BuildSettings(
            train,
            heldout,
            seed,
            chosen.names,
            reachability=reachability,
            physical=in_physics(physical, reachability=reachability),
            modelled=tuple(sorted(model_backed)),
        )
        make_dataset(out, settings, jobs=jobs, layout=layout, own=chosen.own)


@app.command()
def generate(
    out: Out,
    tasks: Annotated[int, typer.Option(min=0, help="Number of training tasks.")] = 480,
    heldout: Annotated[int, typer.Option(min=0, help="Number of evaluation tasks, in other scenes.")] = 0,
    seed: Seed = 0,
    scenes: Scenes = None,
    jobs: Jobs = None,
    reachability: ArmReachability = True,
    physical: Physical = None,
    forms: Forms = None,
    llm: SocialLlm = "",
    model: Model = "",
    key: Key = "",
    cassette: Tape = None,
    price: PriceOfTokens = (0.0, 0.0),
    manager: ManagerAt = "",
    look: Look = False,
    token: Token = "",
    ca: Ca = None,
) -> None:
    """Simulate conversations of a scene's people with the robot, and turn their requests into verified tasks."""
    kind = WriterKind.MODEL if llm or cassette is not None else WriterKind.SOCIAL
    if look and kind is WriterKind.SOCIAL:
        fail("--look needs a language model: give --llm URL and --model NAME, or --cassette FILE")
    model_backed = model_backed_agents(forms)
    with user_errors(out):
        chosen = base_scenes(scenes or DEFAULT_SCENES)
    if look and chosen.own:
        fail(
            f"the scene {next(iter(chosen.own))!r} comes from a file: --look shows scenes of the catalog only; leave it out"
        )
    settings = BuildSettings(
        tasks,
        heldout,
        seed,
        chosen.names,
        kind,
        reachability=reachability,
        physical=in_physics(physical, reachability=reachability),
        modelled=tuple(sorted([*model_backed, *[SCENE_EXTRACTOR] * look])),
    )
    with contextlib.ExitStack() as stack:
        stack.enter_context(user_errors(out, more=MODEL_ERRORS))
        check: VariantCheck | None = None
        if manager:
            trusted = ca.read_bytes() if ca is not None else b""
            check = stack.enter_context(cluster_check(manager, token, trusted))
        layout = stack.enter_context(layout_agents(model_backed, llm, model, key, cassette, FailureLimit()))
        if kind is WriterKind.SOCIAL:
            making = DAYS if layout is None else days_planned_by(partial(plan_day, agents=layout))
            make_dataset(
                out,
                settings,
                jobs=jobs if layout is None else 1,
                check=check,
                making=making,
                own=chosen.own,
            )
            return
        writer, ledger = stack.enter_context(
            model_request_writer(
                llm,
                model,
                key,
                cassette,
                price=Price(*price),
                accounts=out / "ledger.jsonl",
                look=look,
                seed=seed,
            )
        )
        making = days_planned_by(ModelDays(writer, layout).plan)
        summary = make_dataset(out, settings, jobs=1, check=check, making=making, own=chosen.own)
        _print_account(ledger, sum(map(summary.total, ("train", "heldout"))))


def _print_account(ledger: Ledger, admitted: int) -> None:
    """Print the model's calls, tokens and cost by agent, then calls and tokens for each admitted task."""
    show_table(
        ("agent", "calls", "failed", "retries", "tokens in", "tokens out", "seconds", "cost"),
        (
            (purpose, *(round(figure, 4) for figure in astuple(account)))
            for purpose, account in (*ledger.accounts.items(), ("all", ledger.total()))
        ),
    )
    total = ledger.total()
    tokens = total.prompt_tokens + total.completion_tokens
    if admitted and total.calls:
        say(f"{total.calls / admitted:.1f} calls and {tokens / admitted:,.0f} tokens for each admitted task")
