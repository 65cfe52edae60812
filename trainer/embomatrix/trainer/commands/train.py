"""Commands `embomatrix train` and `embomatrix imitate`. torch is imported only after the arguments are parsed."""

from __future__ import annotations

import contextlib
import functools
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from embomatrix.envs.rules import Visibility
from embomatrix.host.failure import INTERRUPTED, fail, unwritable
from embomatrix.host.own_files import prepare_output
from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.client import ClusterClient
from embomatrix.rpc.logs import LogFormat, log_to_stderr
from embomatrix.rpc.options import Ca, Manager, Token
from embomatrix.rpc.trust import read_ca, read_token
from embomatrix.starter.options import DEFAULT_DATASET, DatasetFolder
from embomatrix.trainer.config.errors import TrainerError

if TYPE_CHECKING:
    from embomatrix.rpc.wire.values import Batch
    from embomatrix.trainer.lifecycle.checkpoint import ImitationState
    from embomatrix.trainer.logging.report import TrainingSummary
    from embomatrix.trainer.logging.run_clock import RunClock
    from embomatrix.trainer.run.starting import RunStart
    from embomatrix.trainer.serving.sampler import ServerSampler


Connect = Callable[[], ClusterClient]

_LOG_FORMAT = Annotated[
    LogFormat | None,
    typer.Option(
        help="`json`: also write the log as JSON lines to standard error.",
        envvar="EMBOMATRIX_LOG_FORMAT",
        show_default=False,
    ),
]
_MODEL = Annotated[
    str,
    typer.Option(
        help="`tiny`, a Hugging Face model by name or folder, or a trained policy such as runs/NAME/reference."
    ),
]
_OUT = Annotated[Path, typer.Option(help="Folder for checkpoints, logs and report.")]
_RESUME = Annotated[bool, typer.Option("--resume", help="Continue from the newest checkpoint in --out.")]
_SEED = Annotated[int | None, typer.Option(help="Random seed of policy, task order and sampling.")]
_SETTINGS = Annotated[
    Path | None, typer.Option("--settings", help="TOML file with settings (docs/training.md).")
]
_DEVICE = Annotated[str | None, typer.Option(help="torch device: cpu or cuda.")]
_TRACK = Annotated[
    list[str] | None,
    typer.Option(help="Also send metrics to `tensorboard`, `wandb` or `trackio`. Repeatable."),
]
_IMITATE = Annotated[float | None, typer.Option(min=0, help="Seconds of imitation. Default: 150.")]
_REWARD = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME=VALUE", help="A reward coefficient (docs/rewards.md). Repeatable."),
]
_THREADS = Annotated[
    int | None, typer.Option(min=1, help="torch threads per process. Default: half of the cores in all.")
]
_PROCESSES = Annotated[
    int | None,
    typer.Option(min=1, help="Data-parallel processes. Default: 2 for `tiny`, 1 for other models."),
]


def train(
    dataset: DatasetFolder = DEFAULT_DATASET,
    manager: Manager = DEFAULT_ADDRESS,
    model: _MODEL = "tiny",
    out: _OUT = Path("runs/train"),
    minutes: Annotated[float | None, typer.Option(min=0, help="Minutes of GRPO. Default: 5.")] = None,
    steps: Annotated[int | None, typer.Option(min=0, help="Steps of GRPO instead of minutes.")] = None,
    imitate_seconds: _IMITATE = None,
    imitate_steps: Annotated[
        int | None, typer.Option(min=0, help="Steps of imitation instead of seconds.")
    ] = None,
    evaluate_every: Annotated[
        int | None,
        typer.Option(min=0, help="Steps of GRPO between evaluations on held-out tasks. Default: 0, none."),
    ] = None,
    evaluate_tasks: Annotated[
        int | None,
        typer.Option(min=1, help="Held-out tasks of each evaluation, drawn by the seed. Default: all."),
    ] = None,
    resume: _RESUME = False,
    seed: _SEED = None,
    settings_file: _SETTINGS = None,
    episodes: Annotated[
        Visibility | None,
        typer.Option(
            help="Train call by call instead of on whole plans. The policy is told of all objects, or of those it has seen.",
        ),
    ] = None,
    teacher_rounds: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=100,
            help="Rounds in which the oracle finishes episodes that the policy began (with --episodes). Default: 0.",
        ),
    ] = None,
    reward: _REWARD = None,
    threads: _THREADS = None,
    processes: _PROCESSES = None,
    device: _DEVICE = None,
    track: _TRACK = None,
    sampler_url: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="Address of a vLLM or SGLang server that samples the plans (docs/training.md).",
        ),
    ] = None,
    sampler_kind: Annotated[
        str | None, typer.Option(help="Kind of that server: `vllm` or `sglang`. Default: `vllm`.")
    ] = None,
    sampler_key: Annotated[
        str, typer.Option(envvar="EMBOMATRIX_SAMPLER_KEY", help="API key of that server.")
    ] = "",
    warn_after: Annotated[
        float | None,
        typer.Option(min=0, metavar="MINUTES", help="Print a warning if the run takes longer. It goes on."),
    ] = None,
    record: Annotated[
        Path | None, typer.Option(help="File for every submitted plan, to replay with `bench traffic`.")
    ] = None,
    plan_memory: Annotated[
        str | None,
        typer.Option(
            metavar="MODEL",
            help="Print the peak memory of a run with this model and these settings, and end. Weights are not read.",
        ),
    ] = None,
    gpu_gb: Annotated[
        float, typer.Option(min=0.1, help="Memory of the GPU for --plan-memory, in GB.")
    ] = 80.0,
    token: Token = "",
    ca: Ca = None,
    log_format: _LOG_FORMAT = None,
) -> None:
    """Train a policy: imitation of the oracle, then GRPO on the cluster, with held-out evaluation before and after."""
    began_s = time.monotonic()
    with _report_errors("train", out):
        if log_format is LogFormat.JSON:
            log_to_stderr("info", log_format)
        connect = functools.partial(ClusterClient, manager, read_token(token), ca=read_ca(ca))
        changes = {
            "seed": seed,
            "device": device,
            "threads": threads,
            "processes": processes,
            "grpo.minutes": minutes,
            "grpo.steps": steps,
            "imitation.seconds": imitate_seconds,
            "imitation.steps": imitate_steps,
            "episodes.visibility": episodes,
            "episodes.teacher_rounds": teacher_rounds,
            "evaluation.every": evaluate_every,
            "evaluation.tasks": evaluate_tasks,
            "track": track,
            "sampler.url": sampler_url,
            "sampler.kind": sampler_kind,
            **_coefficients(reward or ()),
        }
        if plan_memory is not None:
            from embomatrix.trainer.run.memory import forecast, memory_text

            found = forecast(dataset, plan_memory, settings_file, changes)
            typer.echo(memory_text(found, gpu_gb))
            return
        from embomatrix.trainer.run.timetable import clock_of

        prepare_output("train", record)
        start = _start(dataset, out, model, settings_file, changes, resume=resume)
        _show_limits(start)
        clock = clock_of(start, began_s=began_s, warn_after_s=None if warn_after is None else 60 * warn_after)
        with start.model_server(out, key=sampler_key) as server:
            _show_summary(_run(start, connect, out, record, clock, server))


def imitate(
    dataset: DatasetFolder = DEFAULT_DATASET,
    model: _MODEL = "tiny",
    out: _OUT = Path("runs/imitate"),
    seconds: Annotated[float | None, typer.Option(min=0, help="Seconds of imitation. Default: 150.")] = None,
    steps: Annotated[int | None, typer.Option(min=0, help="Steps instead of seconds.")] = None,
    patience: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Early stopping: evaluations without a lower validation loss. 0: off.",
        ),
    ] = None,
    resume: _RESUME = False,
    seed: _SEED = None,
    settings_file: _SETTINGS = None,
    threads: _THREADS = None,
    processes: _PROCESSES = None,
    device: _DEVICE = None,
    track: _TRACK = None,
) -> None:
    """Train a policy by imitation of the oracle plans, without a cluster.

    `train --resume` with the same --out continues with GRPO.
    """
    with _report_errors("imitate", out):
        changes = {
            "seed": seed,
            "device": device,
            "threads": threads,
            "processes": processes,
            "imitation.seconds": seconds,
            "imitation.steps": steps,
            "imitation.patience": patience,
            "track": track,
        }
        start = _start(dataset, out, model, settings_file, changes, resume=resume)
        if start.settings.episodes.visibility is not None:
            raise TrainerError(
                "`imitate` learns whole plans, and oracle episodes need a cluster: pass episodes.visibility to "
                "`embomatrix train`, with --steps 0 for imitation alone"
            )
        _show_limits(start)
        _show_imitation(_imitated(start, out), out)


def _start(
    dataset: Path, out: Path, model: str, file: Path | None, changes: Mapping[str, Any], *, resume: bool
) -> RunStart:
    from embomatrix.trainer.run.starting import resume_run, start_run

    if resume:
        return resume_run(dataset, out, changes, model=model, settings_file=file)
    return start_run(dataset, out, model, file, changes)


def _show_limits(start: RunStart) -> None:
    for sentence in start.about_limits:
        Console(soft_wrap=True).print(sentence, highlight=False, markup=False)


@contextlib.contextmanager
def _report_errors(command: str, out: Path | None = None) -> Iterator[None]:
    """Print errors as one sentence: status 2, or 130 for Ctrl-C and SIGTERM. ``out`` is the run's folder."""
    from embomatrix.rpc.status import ClusterError
    from embomatrix.trainer.lifecycle.interrupts import sigterm_as_ctrl_c

    logging.getLogger("embomatrix").addHandler(logging.NullHandler())
    try:
        with sigterm_as_ctrl_c():
            yield
    except (TrainerError, ClusterError) as error:
        fail(command, str(error))
    except KeyboardInterrupt:
        # No import here: an interrupted import of torch can't be repeated.
        saved = out is not None and any((out / "checkpoints").glob("[!.]*"))
        sentence = f"interrupted: continue with `--resume --out={out}`" if saved else "interrupted"
        fail(command, sentence, INTERRUPTED)


def _coefficients(options: Sequence[str]) -> dict[str, str]:
    """Convert ``NAME=VALUE`` options to dotted settings. The settings model validates names and values."""
    pairs = [text.partition("=") for text in options]
    for name, equals, value in pairs:
        if not (name and equals and value):
            raise TrainerError(
                f"--reward {name + equals + value!r}: expected NAME=VALUE, for example goal=10"
            )
    return {f"reward.{name}": value for name, _, value in pairs}


def _run(
    start: RunStart,
    connect: Connect,
    out: Path,
    record: Path | None,
    clock: RunClock,
    server: ServerSampler | None,
) -> TrainingSummary:
    from embomatrix.rpc.wire.values import GroupPolicy, RunTerms
    from embomatrix.trainer.cluster.gateway import Gateway
    from embomatrix.trainer.config.settings import OnLost
    from embomatrix.trainer.logging.display import display_on
    from embomatrix.trainer.logging.trackers import trackers_of
    from embomatrix.trainer.run.loop import TrainingRun

    settings = start.settings
    fails_group = settings.grpo.on_lost is OnLost.GROUP
    policy_on_loss = GroupPolicy.RETRY_THEN_FAIL_GROUP if fails_group else GroupPolicy.PARTIAL
    terms = RunTerms(policy_on_loss, reward=settings.reward.settings())
    with (
        _traffic_log(record) as on_submit,
        Gateway(
            connect, start.tasks.bundle_bytes, run_name=out.name, terms=terms, on_submit=on_submit
        ) as gateway,
        trackers_of(settings, out) as trackers,
        display_on(Console(), clock) as display,
    ):
        return TrainingRun(start, gateway, display, out, trackers, server).run()


@contextlib.contextmanager
def _traffic_log(path: Path | None) -> Iterator[Callable[[Batch], None]]:
    from embomatrix.rpc.traffic import TrafficLog

    if path is None:
        yield lambda _: None
        return
    try:
        log = TrafficLog(path)
    except OSError as error:
        raise TrainerError(unwritable(path, error)) from error
    with contextlib.closing(log):
        yield log.append


def _imitated(start: RunStart, out: Path) -> ImitationState:
    from embomatrix.trainer.learning.data_parallel import DataParallelWorkers
    from embomatrix.trainer.lifecycle.checkpoint import atomic_folder
    from embomatrix.trainer.logging.display import display_on
    from embomatrix.trainer.logging.recorder import Recorder
    from embomatrix.trainer.logging.trackers import trackers_of
    from embomatrix.trainer.run.imitation import run_imitation
    from embomatrix.trainer.run.starting import REFERENCE
    from embomatrix.trainer.run.timetable import imitation_clock

    progress = start.progress
    if progress.grpo_ready:
        raise TrainerError(
            f"imitation of the run in {out} is finished: continue with `embomatrix train --resume`"
        )
    clock = imitation_clock(start, began_s=time.monotonic())
    with (
        trackers_of(start.settings, out) as trackers,
        display_on(Console(), clock) as display,
        DataParallelWorkers.start(start.policy, start.settings) as workers,
    ):
        run_imitation(start, workers, out, Recorder(out, trackers), display.imitation)
    with atomic_folder(out / REFERENCE) as folder:
        start.policy.save(folder)
    return progress.imitation


def _show_imitation(state: ImitationState, out: Path) -> None:
    best = (
        f", lowest validation loss {state.best_loss:.3f} at step {state.best_step}"
        if state.best_loss is not None
        else ""
    )
    Console(soft_wrap=True).print(
        f"{state.step} imitation steps in {state.seconds:.0f} s{best}\npolicy      {out / 'reference'}\n"
        f"continue    embomatrix train --resume --out={out}",
        highlight=False,
        markup=False,
    )


def _show_summary(summary: TrainingSummary) -> None:
    from embomatrix.trainer.logging.report import prewarm_share, success_rows

    console = Console(markup=False)
    title = "held-out success, 95 % intervals"
    table = Table(
        "category", "tasks", "before GRPO", "after GRPO", "difference", title=title, title_justify="left"
    )
    for row in success_rows(summary):
        table.add_row(*row)
    if table.rows:
        console.print(table)
    outcome, stats = summary.outcome, summary.stats
    console.print(
        f"{outcome.imitation_steps} imitation steps, {outcome.steps} GRPO steps, {outcome.rollouts} rollouts, "
        f"{outcome.lost} lost by the infrastructure, {stats.redispatched} re-dispatched; "
        f"{stats.warm_starts} warm and {stats.cold_starts} cold starts, announced scenes loaded before their first rollout: "
        f"{prewarm_share(stats)}, steps reused from equal beginnings of other plans: {stats.shared_share:.0%}; "
        f"peak memory of the main process {outcome.peak_mb:,.0f} MB",
        highlight=False,
    )
    console.print(f"report      {summary.report}\ncheckpoint  {summary.checkpoint}", highlight=False)
