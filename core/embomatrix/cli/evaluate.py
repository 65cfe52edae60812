"""`embomatrix eval`: how good a model is on a benchmark, with the answers kept, so that the table can be made again.

torch is imported only where a policy runs in this process, the physics engine only where no manager is given.
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import os
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from embomatrix.cli.failure import INTERRUPTED, fail
from embomatrix.skills.prompt import Codec
from embomatrix.trainer.errors import TrainerError
from embomatrix.trainer.evaluation.answers import FILE, AnswerSheet, Setup, ordered, read_answers
from embomatrix.trainer.evaluation.asking import BaselineAsker, EndpointAsker, PolicyAsker, questions_digest
from embomatrix.trainer.evaluation.baselines import BaselineName, baseline_for
from embomatrix.trainer.evaluation.benchmark import find_benchmark
from embomatrix.trainer.evaluation.cluster import ClusterExecutor
from embomatrix.trainer.evaluation.judging import Judge
from embomatrix.trainer.evaluation.page import evaluation_page
from embomatrix.trainer.evaluation.pictures import chosen_pictures
from embomatrix.trainer.evaluation.scoreboard import Scoreboard
from embomatrix.trainer.evaluation.table import read_row, report_of, text_report
from embomatrix.world.task import MAX_TABLE
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from embomatrix.trainer.evaluation.answers import Answer
    from embomatrix.trainer.evaluation.asking import Asker
    from embomatrix.trainer.evaluation.benchmark import Benchmark
    from embomatrix.trainer.evaluation.judging import Executor
    from embomatrix.trainer.evaluation.table import Row

DEFAULT_BENCH: Final = "build/dataset"
DEFAULT_OUT: Final = Path("runs/eval")
DEFAULT_SAMPLES: Final = 10
ENDPOINT_TOKENS: Final = 1024
"""A plan of 64 steps in JSON, and some reasoning before it."""
console = Console(highlight=False, markup=False, soft_wrap=True)


@dataclass(frozen=True, slots=True)
class Questions:
    """How tasks are asked: None where the asked one's own default is wanted."""

    samples: int
    temperature: float
    seed: int
    max_tokens: int | None
    codec: Codec


@dataclass(frozen=True, slots=True)
class Asked:
    """Who is asked, and what its setup says of it."""

    asker: Asker
    label: str
    codec: Codec
    rows: int
    max_tokens: int


def evaluate(
    model: Annotated[
        str, typer.Option(help="Checkpoint folder, or a Hugging Face model by name or folder.")
    ] = "",
    endpoint: Annotated[
        str, typer.Option(help="Any OpenAI-compatible endpoint: what comes before /chat/completions.")
    ] = "",
    model_name: Annotated[str, typer.Option(help="The model's name at the endpoint.")] = "",
    key: Annotated[
        str, typer.Option("--llm-key", envvar="EMBOMATRIX_LLM_KEY", help="Key of the endpoint.")
    ] = "",
    baseline: Annotated[
        BaselineName | None, typer.Option(help="A baseline that needs no model.", show_default=False)
    ] = None,
    answers: Annotated[
        Path | None, typer.Option(help="Judge the stored answers of an evaluation; asks nobody.")
    ] = None,
    bench: Annotated[
        str, typer.Option(help="internal-verified, eai, a dataset folder, or a file of task records.")
    ] = "",
    split: Annotated[
        str, typer.Option(help="heldout, train or all; else heldout where the dataset has any.")
    ] = "",
    tasks: Annotated[int | None, typer.Option(min=1, help="The first so many tasks only.")] = None,
    samples: Annotated[int, typer.Option(min=1, max=1000, help="Plans of each task.")] = DEFAULT_SAMPLES,
    temperature: Annotated[float, typer.Option(min=0, help="0 takes the likeliest plan.")] = 1.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of sampling and of execution.")] = 0,
    max_tokens: Annotated[int | None, typer.Option(min=1, help="Tokens of an answer at most.")] = None,
    codec: Annotated[
        Codec, typer.Option(help="How a language model writes plans: json or lines.")
    ] = Codec.JSON,
    concurrent: Annotated[int, typer.Option(min=1, help="Questions under way at the endpoint.")] = 8,
    attempts: Annotated[int, typer.Option(min=1, help="Attempts at a question, with waits between.")] = 6,
    manager: Annotated[
        str,
        typer.Option(
            help="HOST:PORT of a manager that executes; else this machine.", envvar="EMBOMATRIX_MANAGER"
        ),
    ] = "",
    token: Annotated[
        str, typer.Option(help="Token of the trainer role, or @FILE.", envvar="EMBOMATRIX_TOKEN")
    ] = "",
    ca: Annotated[
        Path | None, typer.Option(help="The ca.pem of a manager that serves by TLS.", envvar="EMBOMATRIX_CA")
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Simulator processes without a manager.")] = None,
    out: Annotated[
        Path | None, typer.Option(help=f"Folder of answers and report; else {DEFAULT_OUT}/BENCH-MODEL.")
    ] = None,
    beside: Annotated[
        list[Path] | None, typer.Option(help="A report.json of the same tasks, as a row beside. Repeatable.")
    ] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="Threads of torch.")] = None,
    device: Annotated[str, typer.Option(help="torch device of --model: cpu, cuda.")] = "cpu",
) -> None:
    """Measure a model, an endpoint or a baseline: success by category with intervals, and why plans fail.

    Answers are kept as they come: the same command goes on where an earlier one ended.
    """
    with _problems_shown():
        if sum(map(bool, (model, endpoint, baseline, answers))) != 1:
            raise TrainerError(
                "expected one of --model, --endpoint, --baseline and --answers: give one of them"
            )
        executor = functools.partial(_executor, manager, token, ca, jobs)
        if answers is not None:
            _judge_stored(answers, bench, out, executor, beside or [])
            return
        found = find_benchmark(bench or DEFAULT_BENCH, split, tasks)
        asked_for = Questions(samples, temperature, seed, max_tokens, codec)
        folder = out or DEFAULT_OUT / _file_name(f"{Path(found.name).name}-{model or model_name or baseline}")
        if model:
            asked = _policy(model, asked_for, threads, device)
        elif endpoint:
            asked = _endpoint(endpoint, model_name, key, asked_for, (concurrent, attempts), folder)
        else:
            asked = _baseline(baseline or BaselineName.ORACLE)
        _ask_and_judge(found, asked, asked_for, folder, executor, beside or [])


@contextlib.contextmanager
def _problems_shown() -> Iterator[None]:
    """What a person can mend is one sentence and status 2; an interrupt says what is kept."""
    from embomatrix.rpc.status import ClusterError
    from embomatrix.sim.engine import EngineError

    logging.getLogger("embomatrix").addHandler(logging.NullHandler())
    try:
        yield
    except (TrainerError, ClusterError, EngineError) as error:
        fail("eval", str(error))
    except KeyboardInterrupt:
        fail(
            "eval",
            f"interrupted: answers so far are kept in {FILE}; the same command goes on from there",
            INTERRUPTED,
        )


def _executor(manager: str, token: str, ca: Path | None, jobs: int | None, found: Benchmark) -> Executor:
    """A cluster where a manager is named, else processes of this machine."""
    if not manager:
        from embomatrix.worker.rollout_pool import RolloutPool

        return RolloutPool(found.folder, jobs or os.cpu_count() or 1)
    from embomatrix.rpc.client import ClusterClient
    from embomatrix.rpc.trust import read_ca, read_token

    connect = functools.partial(ClusterClient, manager, read_token(token), ca=read_ca(ca))
    return ClusterExecutor(connect, found.dataset.bundle_bytes)


def _policy(model: str, asked_for: Questions, threads: int | None, device: str) -> Asked:
    from embomatrix.trainer.evaluation.models import load_model

    loaded = load_model(model, asked_for.codec, threads=threads, device=device)
    tokens = asked_for.max_tokens or loaded.max_tokens
    return Asked(PolicyAsker(loaded.policy), model, loaded.policy.codec, loaded.rows, tokens)


def _endpoint(
    url: str, name: str, key: str, asked_for: Questions, limits: tuple[int, int], folder: Path
) -> Asked:
    if not name:
        raise TrainerError("the endpoint's model has no name: pass --model-name as the endpoint calls it")
    if asked_for.codec is Codec.NAMES:
        raise TrainerError("the codec `names` is for word-level policies: pass --codec json or lines")
    from embomatrix.llm.endpoint import Endpoint, EndpointLimits

    concurrent, attempts = limits
    bounds = EndpointLimits(attempts=attempts, concurrent=concurrent)
    opened = functools.partial(Endpoint, url, name, api_key=key, limits=bounds)
    asker = EndpointAsker(opened, asked_for.codec, folder / "ledger.jsonl")
    return Asked(asker, name, asked_for.codec, MAX_TABLE, asked_for.max_tokens or ENDPOINT_TOKENS)


def _baseline(name: BaselineName) -> Asked:
    return Asked(BaselineAsker(baseline_for(name)), name.value, Codec.JSON, MAX_TABLE, 1)


def _ask_and_judge(
    found: Benchmark,
    asked: Asked,
    asked_for: Questions,
    folder: Path,
    executor: Callable[[Benchmark], Executor],
    beside: Sequence[Path],
) -> None:
    rows = [read_row(path, found.digest) for path in beside]
    setup = Setup(
        bench=found.name,
        bench_digest=found.digest,
        split=found.split,
        tasks=len(found.records),
        model=asked.label,
        codec=asked.codec.value,
        rows=asked.rows,
        samples=asked_for.samples,
        temperature=asked_for.temperature,
        max_tokens=asked.max_tokens,
        seed=asked_for.seed,
        questions=questions_digest(found.tasks.values(), asked.codec, asked.rows),
        by_rule=len(found.failed_by_rule),
    )
    began_s = time.monotonic()
    with AnswerSheet(folder / FILE, setup) as sheet:
        if len(sheet):
            console.print(f"{len(sheet)} answers are there already")
        with _bar("answers") as report:
            asked.asker.ask(list(found.tasks.values()), sheet, report)
        given = sheet.ordered(found.tasks)
    console.print(f"{len(given)} answers in {time.monotonic() - began_s:.1f} s: {folder / FILE}")
    _judge(found, setup, given, executor(found), folder, rows)


def _judge_stored(
    path: Path,
    bench: str,
    out: Path | None,
    executor: Callable[[Benchmark], Executor],
    beside: Sequence[Path],
) -> None:
    setup, stored = read_answers(path)
    found = find_benchmark(bench or setup.bench, setup.split, setup.tasks)
    if found.digest != setup.bench_digest:
        raise TrainerError(
            f"{path} answers other tasks than {bench or setup.bench} holds now (digest {setup.bench_digest[:19]}…, now "
            f"{found.digest[:19]}…): pass the benchmark that was asked with --bench"
        )
    task_ids = [record.task.task_id for record in found.records]
    given = ordered(stored, task_ids, setup.samples)
    missing = len(task_ids) * setup.samples - len(given)
    if missing:
        console.print(
            f"{missing} of {len(task_ids) * setup.samples} answers are missing: figures are over the others"
        )
    rows = [read_row(row, found.digest) for row in beside]
    _judge(found, setup, given, executor(found), out or path.parent, rows)


def _judge(
    found: Benchmark,
    setup: Setup,
    given: Sequence[Answer],
    executor: Executor,
    folder: Path,
    rows: Sequence[Row],
) -> None:
    began_s = time.monotonic()
    with _bar("plans executed") as report:
        judged = Judge(found, setup, executor).judge(given, report)
    board = Scoreboard.of([record.task for record in found.records], judged.verdicts, setup.by_rule)
    value = report_of(setup, board)
    text = text_report(value, rows)
    page = evaluation_page(value, chosen_pictures(found, board, judged.plans), rows)
    _write(folder / "report.json", json.dumps(value, indent=1) + "\n")
    _write(folder / "report.txt", text)
    _write(folder / "report.html", page)
    console.print(text)
    console.print(
        f"executed and judged in {time.monotonic() - began_s:.1f} s: {folder / 'report.html'}, .json, .txt"
    )


def _write(path: Path, text: str) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, text.encode("utf-8"))
    except OSError as error:
        raise TrainerError(f"{path} can't be written ({error.strerror}): pass another --out") from error


@contextlib.contextmanager
def _bar(name: str) -> Iterator[Callable[[int, int], None]]:
    columns: Any = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        bar = progress.add_task(name, total=None)
        yield lambda done, total: progress.update(bar, completed=done, total=total)


def _file_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip("-.") or "model"
