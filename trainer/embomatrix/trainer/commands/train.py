"""`embomatrix train` and `embomatrix imitate`. torch is imported after the arguments are read."""

from __future__ import annotations

import contextlib
import functools
import logging
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from rich.console import Console
from rich.table import Table

from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.logs import LogFormat, log_to_stderr
from embomatrix.trainer.config.errors import TrainerError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from embomatrix.rpc.client import ClusterClient
    from embomatrix.trainer.cluster.gateway import Gateway
    from embomatrix.trainer.config.settings import OnLost, TrainSettings
    from embomatrix.trainer.data.tasks import TaskSet
    from embomatrix.trainer.imitation.teacher_forcing import ImitationState
    from embomatrix.trainer.logging.report import TrainingSummary
    from embomatrix.trainer.run.starting import Start

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
_MODEL = Annotated[
    str,
    typer.Option(
        help="`tiny`, a Hugging Face model by name or folder, or a policy that was trained: runs/NAME/reference."
    ),
]
_OUT = Annotated[Path, typer.Option(help="Folder for checkpoints, logs and report.")]
_RESUME = Annotated[bool, typer.Option("--resume", help="Go on from the newest checkpoint in --out.")]
_SEED = Annotated[int | None, typer.Option(help="Seed of policy, task order and sampling.")]
_SETTINGS = Annotated[Path | None, typer.Option("--settings", help="TOML file with any setting.")]
_DEVICE = Annotated[str | None, typer.Option(help="torch device: cpu, cuda.")]
_TRACK = Annotated[
    list[str] | None,
    typer.Option(help="Send metrics to `tensorboard`, `wandb` or `trackio` as well; repeatable."),
]
_IMITATE = Annotated[float | None, typer.Option(min=0, help="Seconds of imitation; default 150.")]
_REWARD = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=VALUE", help="A coefficient of the reward, as docs/rewards.md names it; repeatable."
    ),
]
_THREADS = Annotated[int | None, typer.Option(min=1, help="Threads of torch; default: half of the cores.")]
_PROCESSES = Annotated[
    int | None,
    typer.Option(
        min=1, help="Processes that sample and learn side by side; default: 2 for `tiny`, 1 for other models."
    ),
]


def train(
    dataset: _DATASET = Path("build/dataset"),
    manager: _MANAGER = DEFAULT_ADDRESS,
    model: _MODEL = "tiny",
    out: _OUT = Path("runs/train"),
    minutes: Annotated[float | None, typer.Option(min=0, help="Minutes of GRPO; default 5.")] = None,
    steps: Annotated[int | None, typer.Option(min=0, help="Steps of GRPO, in place of minutes.")] = None,
    imitate_seconds: _IMITATE = None,
    resume: _RESUME = False,
    seed: _SEED = None,
    settings_file: _SETTINGS = None,
    reward: _REWARD = None,
    threads: _THREADS = None,
    processes: _PROCESSES = None,
    device: _DEVICE = None,
    track: _TRACK = None,
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
            "processes": processes,
            "grpo.minutes": minutes,
            "grpo.steps": steps,
            "imitation.seconds": imitate_seconds,
            "track": track,
            **_coefficients(reward or ()),
        }
        from embomatrix.trainer.run.starting import resumed, started

        new = functools.partial(started, dataset, out, model, settings_file, changes)
        again = functools.partial(resumed, dataset, out, changes, model=model, settings_file=settings_file)
        start = again() if resume else new()
        _show_summary(_run(start, connect, out))


def imitate(
    dataset: _DATASET = Path("build/dataset"),
    model: _MODEL = "tiny",
    out: _OUT = Path("runs/imitate"),
    seconds: Annotated[float | None, typer.Option(min=0, help="Seconds of it; default 150.")] = None,
    steps: Annotated[int | None, typer.Option(min=0, help="Steps, in place of seconds.")] = None,
    patience: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Set tasks aside, and stop after so many measurements in a row without a lower loss on them.",
        ),
    ] = None,
    resume: _RESUME = False,
    seed: _SEED = None,
    settings_file: _SETTINGS = None,
    threads: _THREADS = None,
    device: _DEVICE = None,
    track: _TRACK = None,
) -> None:
    """Warm a policy up on the oracle's plans; no cluster is needed. `train --resume` with the same --out goes on with GRPO."""
    with _problems_shown("imitate", out):
        changes = {
            "seed": seed,
            "device": device,
            "threads": threads,
            "imitation.seconds": seconds,
            "imitation.steps": steps,
            "imitation.patience": patience,
            "track": track,
        }
        from embomatrix.trainer.run.starting import resumed, started

        new = functools.partial(started, dataset, out, model, settings_file, changes)
        again = functools.partial(resumed, dataset, out, changes, model=model, settings_file=settings_file)
        start = again() if resume else new()
        _show_imitation(_imitated(start, out), out)


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
        from embomatrix.trainer.run.starting import has_checkpoint

        saved = out is not None and has_checkpoint(out)
        _leave(command, f"interrupted: go on with `--resume --out={out}`" if saved else "interrupted", 130)


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


def _connector(manager: str, token: str, ca: Path | None) -> Connect:
    """How to reach the manager: what the options name is read once. Raises ClusterError."""
    from embomatrix.rpc.client import ClusterClient
    from embomatrix.rpc.trust import read_ca, read_token

    return functools.partial(ClusterClient, manager, read_token(token), ca=read_ca(ca))


def _gateway(
    tasks: TaskSet, connect: Connect, name: str, settings: TrainSettings, on_lost: OnLost
) -> Gateway:
    from embomatrix.rpc.wire.values import GroupPolicy, RunTerms
    from embomatrix.trainer.cluster.gateway import Gateway
    from embomatrix.trainer.config.settings import OnLost

    whole = on_lost is OnLost.GROUP
    policy = GroupPolicy.RETRY_THEN_FAIL_GROUP if whole else GroupPolicy.PARTIAL
    terms = RunTerms(policy, reward=settings.reward.settings())
    return Gateway(connect, tasks.bundle_bytes, run_name=name, run_seed=settings.seed, terms=terms)


def _run(start: Start, connect: Connect, out: Path) -> TrainingSummary:
    from embomatrix.trainer.logging.display import display_for
    from embomatrix.trainer.logging.trackers import trackers_of
    from embomatrix.trainer.policy.loading import saved_policy
    from embomatrix.trainer.run.loop import REFERENCE, Parts, TrainingRun

    settings, tasks, policy = start.settings, start.tasks, start.policy
    prepared = start.progress.prepared
    reference = saved_policy(out / REFERENCE, settings).frozen_copy() if prepared else None
    with (
        _gateway(tasks, connect, out.name, settings, settings.grpo.on_lost) as gateway,
        trackers_of(settings, out) as trackers,
        display_for(Console()) as display,
    ):
        parts = Parts(policy, start.teller, tasks, gateway, display, reference)
        return TrainingRun(parts, settings, out, start.progress, trackers).run()


def _imitated(start: Start, out: Path) -> ImitationState:
    from embomatrix.trainer.lifecycle.checkpoint import whole_folder
    from embomatrix.trainer.logging.display import display_for
    from embomatrix.trainer.logging.recorder import Recorder
    from embomatrix.trainer.logging.trackers import trackers_of
    from embomatrix.trainer.run.imitation import warm_up
    from embomatrix.trainer.run.loop import REFERENCE

    progress = start.progress
    if progress.prepared:
        raise TrainerError(
            f"{out} holds a run that is past its imitation: go on with `embomatrix train --resume`"
        )
    with trackers_of(start.settings, out) as trackers, display_for(Console()) as display:
        recorder = Recorder(out, trackers)
        warm_up(
            start.policy,
            start.teller,
            start.tasks.train,
            start.settings,
            out,
            progress,
            recorder,
            display.imitation,
        )
    with whole_folder(out / REFERENCE) as folder:
        start.policy.save(folder)
    return progress.imitation


def _show_imitation(state: ImitationState, out: Path) -> None:
    best = (
        f", loss {state.best_loss:.3f} on tasks set aside, lowest at step {state.best_step}"
        if state.best_loss is not None
        else ""
    )
    Console(soft_wrap=True).print(
        f"{state.step} imitation steps in {state.seconds:.0f} s{best}\npolicy      {out / 'reference'}\n"
        f"go on       embomatrix train --resume --out={out}",
        highlight=False,
    )


def _show_summary(summary: TrainingSummary) -> None:
    from embomatrix.trainer.logging.report import prewarm_share, success_rows, time_rows

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
        f"{stats.warm_starts} warm and {stats.cold_starts} cold starts, prewarm hits {prewarm_share(stats):.0%}; "
        f"{summary.peak_mb:,.0f} MB of memory at most",
        highlight=False,
    )
    console.print(f"report      {summary.report}\ncheckpoint  {summary.checkpoint}", highlight=False)


def _table(console: Console, title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    table = Table(*head, title=title, title_justify="left")
    for row in rows:
        table.add_row(*row)
    console.print(table)
