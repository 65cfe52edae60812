"""`embomatrix train`. torch is imported after the arguments are read."""

from __future__ import annotations

import contextlib
import functools
import logging
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.table import Table

from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.logs import LogFormat, log_to_stderr
from embomatrix.trainer.errors import TrainerError, reason_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from embomatrix.rpc.client import ClusterClient
    from embomatrix.trainer.data import TaskSet
    from embomatrix.trainer.policy.protocol import Policy
    from embomatrix.trainer.report import Summary
    from embomatrix.trainer.rollout import Gateway
    from embomatrix.trainer.settings import OnLost, TrainSettings
    from embomatrix.trainer.telling import Teller

    Connect = Callable[[], ClusterClient]

_DATASET = Annotated[Path, typer.Option(help="Folder that `embomatrix factory build` wrote.")]
_MANAGER = Annotated[
    str, typer.Option(help="HOST:PORT of the Simulation Manager.", envvar="EMBOMATRIX_MANAGER")
]
_TOKEN = Annotated[
    str,
    typer.Option(help="Token of the trainer role, or @FILE that holds it.", envvar="EMBOMATRIX_TOKEN"),
]
_CA = Annotated[
    Path | None, typer.Option(help="The ca.pem of a manager that serves by TLS.", envvar="EMBOMATRIX_CA")
]
_LOG_FORMAT = Annotated[
    LogFormat | None,
    typer.Option(
        help="`json`: tell the log as JSON lines on standard error, beside the progress.",
        envvar="EMBOMATRIX_LOG_FORMAT",
        show_default=False,
    ),
]
_THREADS = Annotated[int | None, typer.Option(min=1, help="Threads of torch; default: half of the cores.")]


def train(
    dataset: _DATASET = Path("build/dataset"),
    manager: _MANAGER = DEFAULT_ADDRESS,
    model: Annotated[str, typer.Option(help="`tiny`, or a Hugging Face model by name or folder.")] = "tiny",
    out: Annotated[Path, typer.Option(help="Folder for checkpoints, logs and report.")] = Path("runs/train"),
    minutes: Annotated[float | None, typer.Option(min=0, help="Minutes of GRPO; default 5.")] = None,
    steps: Annotated[int | None, typer.Option(min=0, help="Steps of GRPO, in place of minutes.")] = None,
    imitate_seconds: Annotated[
        float | None, typer.Option(min=0, help="Seconds of imitation; default 150.")
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from the newest checkpoint in --out.")
    ] = False,
    seed: Annotated[int | None, typer.Option(help="Seed of policy, task order and sampling.")] = None,
    settings_file: Annotated[
        Path | None, typer.Option("--settings", help="TOML file with any setting.")
    ] = None,
    reward: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE", help="A coefficient of the reward, as docs/rewards.md names it; repeatable."
        ),
    ] = None,
    threads: _THREADS = None,
    device: Annotated[str | None, typer.Option(help="torch device: cpu, cuda.")] = None,
    token: _TOKEN = "",
    ca: _CA = None,
    log_format: _LOG_FORMAT = None,
) -> None:
    """Train a policy: imitation of the oracle, then GRPO on the cluster, measured on held-out tasks."""
    with _problems_shown("train", out):
        if log_format is LogFormat.JSON:
            log_to_stderr("info", log_format)
        connect = _connector(manager, token, ca)
        changes = {
            "seed": seed,
            "device": device,
            "threads": threads,
            "grpo.minutes": minutes,
            "grpo.steps": steps,
            "imitation.seconds": imitate_seconds,
            **_coefficients(reward or ()),
        }
        if resume:
            summary = _resumed(dataset, connect, out, changes)
        else:
            summary = _started(dataset, connect, out, model, settings_file, changes)
        _show_summary(summary)


@contextlib.contextmanager
def _problems_shown(command: str, out: Path | None = None) -> Iterator[None]:
    """What a person can mend is one sentence and status 2, an interrupt one and 130. ``out`` is the run's folder."""
    from embomatrix.rpc.status import ClusterError

    logging.getLogger("embomatrix").addHandler(logging.NullHandler())
    try:
        yield
    except (TrainerError, ClusterError) as error:
        _leave(command, str(error), 2)
    except KeyboardInterrupt:
        saved = out is not None and _saved(out)
        _leave(command, f"interrupted: go on with `--resume --out={out}`" if saved else "interrupted", 130)


def _saved(out: Path) -> bool:
    """Whether the folder holds a checkpoint to go on from."""
    return any((out / "checkpoints").glob("step-*"))


def _leave(command: str, sentence: str, status: int) -> NoReturn:
    Console(stderr=True, soft_wrap=True).print(
        f"embomatrix {command}: {sentence}", highlight=False, markup=False
    )
    raise typer.Exit(status) from None


def _coefficients(told: Sequence[str]) -> dict[str, str]:
    """Settings by dotted key, from ``NAME=VALUE``; whether there is such a one and what it may be, the settings know."""
    pairs = [text.partition("=") for text in told]
    for name, equals, value in pairs:
        if not (name and equals and value):
            raise TrainerError(
                f"--reward {name + equals + value!r}: expected NAME=VALUE, for example goal=10"
            )
    return {f"reward.{name}": value for name, _, value in pairs}


def _started(
    dataset: Path,
    connect: Connect,
    out: Path,
    model: str,
    settings_file: Path | None,
    changes: dict[str, Any],
) -> Summary:
    from embomatrix.trainer.policy.choice import TINY, new_policy
    from embomatrix.trainer.settings import LANGUAGE_MODEL_DEFAULTS, read_settings

    threads = changes["threads"] or max(1, (os.cpu_count() or 2) // 2)
    defaults = {} if model == TINY else LANGUAGE_MODEL_DEFAULTS
    settings = read_settings(settings_file, {**changes, "model": model, "threads": threads}, defaults)
    if _saved(out):
        raise TrainerError(f"{out} holds another run: pass --resume to go on with it, or another --out")
    tasks = _loaded(dataset, settings)
    policy = new_policy(settings, tasks)
    return _run(policy, tasks, connect, settings, out)


def _resumed(dataset: Path, connect: Connect, out: Path, changes: dict[str, Any]) -> Summary:
    from embomatrix.trainer.checkpoint import CheckpointStore, read_state
    from embomatrix.trainer.loop import CHECKPOINTS, REFERENCE
    from embomatrix.trainer.policy.choice import saved_policy

    newest = CheckpointStore(out / CHECKPOINTS, keep=1).latest()
    if newest is None:
        raise TrainerError(
            f"there is no checkpoint in {out} to resume from: leave out --resume, or pass its --out"
        )
    progress, settings = read_state(newest)
    settings = _changed(settings, changes)
    tasks = _loaded(dataset, settings)
    policy = saved_policy(newest / "policy", settings)
    reference = saved_policy(out / REFERENCE, settings).frozen_copy()
    return _run(policy, tasks, connect, settings, out, progress=progress, reference=reference)


def _changed(settings: TrainSettings, changes: dict[str, Any]) -> TrainSettings:
    from embomatrix.trainer.settings import with_changes

    return with_changes(settings.model_dump(), changes)


def _loaded(dataset: Path, settings: TrainSettings) -> TaskSet:
    import torch

    from embomatrix.trainer.data import load_tasks

    torch.set_num_threads(settings.threads)
    try:
        torch.empty(0, device=settings.device)
    except (RuntimeError, AssertionError) as error:
        raise TrainerError(
            f"the device {settings.device!r} can't be used ({reason_of(error)}): expected cpu, or cuda where torch finds a GPU"
        ) from error
    return load_tasks(dataset)


def _teller(policy: Policy, tasks: TaskSet, settings: TrainSettings) -> Teller:
    from embomatrix.trainer.augment import Variation
    from embomatrix.trainer.telling import Teller

    told = settings.prompt
    return Teller(policy, told.rows, Variation(tasks.kinds, told.rename_share, told.drop_share))


def _connector(manager: str, token: str, ca: Path | None) -> Connect:
    """How to reach the manager: what the options name is read once. Raises ClusterError."""
    from embomatrix.rpc.client import ClusterClient
    from embomatrix.rpc.trust import read_ca, read_token

    return functools.partial(ClusterClient, manager, read_token(token), ca=read_ca(ca))


def _gateway(
    tasks: TaskSet, connect: Connect, name: str, settings: TrainSettings, on_lost: OnLost
) -> Gateway:
    from embomatrix.rpc.values import GroupPolicy, RunTerms
    from embomatrix.trainer.rollout import Gateway
    from embomatrix.trainer.settings import OnLost

    whole = on_lost is OnLost.GROUP
    policy = GroupPolicy.RETRY_THEN_FAIL_GROUP if whole else GroupPolicy.PARTIAL
    terms = RunTerms(policy, reward=settings.reward.settings())
    return Gateway(connect, tasks.bundle_bytes, run_name=name, run_seed=settings.seed, terms=terms)


def _run(
    policy: Policy,
    tasks: TaskSet,
    connect: Connect,
    settings: TrainSettings,
    out: Path,
    **resumed: Any,
) -> Summary:
    from embomatrix.trainer.loop import Parts, TrainingRun
    from embomatrix.trainer.progress import display_for

    console = Console()
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise TrainerError(
            f"the folder {out} can't be made ({error.strerror}): pass another --out"
        ) from error
    reference = resumed.pop("reference", None)
    with (
        _gateway(tasks, connect, out.name, settings, settings.grpo.on_lost) as gateway,
        display_for(console) as display,
    ):
        parts = Parts(policy, _teller(policy, tasks, settings), tasks, gateway, display, reference)
        return TrainingRun(parts, settings, out, **resumed).run()


def _show_summary(summary: Summary) -> None:
    from embomatrix.trainer.report import prewarm_share, success_rows, time_rows

    console = Console()
    rows = success_rows(summary)
    if rows:
        _table(
            console, "held-out success, 95 % intervals", ("tasks", "before GRPO", "after", "difference"), rows
        )
    times = [(name, f"{spent:.0f} s", f"{share:.0%}") for name, spent, share in time_rows(summary)]
    _table(console, "where the time went", ("activity", "time", "share"), times)
    stats = summary.stats
    console.print(
        f"{summary.imitation_steps} imitation steps, {summary.steps} GRPO steps, {summary.rollouts} rollouts, "
        f"{summary.lost} lost and masked; {stats.redispatched} re-dispatched, "
        f"{stats.warm_starts} warm and {stats.cold_starts} cold starts, prewarm hits {prewarm_share(stats):.0%}",
        highlight=False,
    )
    console.print(f"report      {summary.report}\ncheckpoint  {summary.checkpoint}", highlight=False)


def _table(console: Console, title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    table = Table(*head, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    console.print(table)
