"""`embomatrix eval`: how good a model is on a benchmark, with the answers kept, so that the table can be made again.

torch is imported only where a policy runs in this process, the physics engine only where no manager is given.
"""

from __future__ import annotations

import contextlib
import functools
import json
import logging
import re
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from embomatrix.cli.examinee import Chosen, Questions, asked_of
from embomatrix.cli.failure import INTERRUPTED, fail
from embomatrix.host.cores import usable_cores
from embomatrix.skills.prompt import Codec
from embomatrix.trainer.cluster.executor import ClusterExecutor
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.eai.exam import CODEC as EAI_CODEC
from embomatrix.trainer.eai.exam import NAME as NATIVE
from embomatrix.trainer.eai.exam import NativeExam
from embomatrix.trainer.evaluation.answer_sources import questions_digest
from embomatrix.trainer.evaluation.answers import (
    FILE,
    MOST_SAMPLES,
    AnswerSheet,
    EvaluationSetup,
    check_expected,
    ordered,
    read_answers,
)
from embomatrix.trainer.evaluation.baselines import BaselineName
from embomatrix.trainer.evaluation.benchmark import find_benchmark
from embomatrix.trainer.evaluation.exam import WorldExam
from embomatrix.trainer.evaluation.page import evaluation_page
from embomatrix.trainer.evaluation.table import read_row, report_of, text_report
from embomatrix.world.task import Profile
from embomatrix.world.whole_file import write_whole

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from embomatrix.cli.examinee import EvaluationSubject
    from embomatrix.trainer.cluster.executor import Executor
    from embomatrix.trainer.evaluation.answers import Answer
    from embomatrix.trainer.evaluation.benchmark import Benchmark
    from embomatrix.trainer.evaluation.exam import Exam
    from embomatrix.trainer.evaluation.table import ScoreRow

DEFAULT_BENCH: Final = "build/dataset"
DEFAULT_OUT: Final = Path("runs/eval")
DEFAULT_SAMPLES: Final = 10
console = Console(highlight=False, markup=False, soft_wrap=True)


@dataclass(frozen=True, slots=True)
class ExecutionTarget:
    """Where plans are executed: on a cluster if ``manager`` is given, else in ``jobs`` processes of this machine."""

    manager: str
    token: str
    ca: Path | None
    jobs: int | None

    def executor(self, bench: Benchmark) -> Executor:
        if not self.manager:
            from embomatrix.worker.slots.rollout_pool import RolloutPool

            return RolloutPool(bench.folder, self.jobs or usable_cores())
        from embomatrix.rpc.client import ClusterClient
        from embomatrix.rpc.trust import read_ca, read_token

        connect = functools.partial(ClusterClient, self.manager, read_token(self.token), ca=read_ca(self.ca))
        return ClusterExecutor(connect, bench.dataset.bundle_bytes)


_Model = Annotated[str, typer.Option(help="Checkpoint folder, or a Hugging Face model by name or folder.")]
_Endpoint = Annotated[
    str, typer.Option(help="Any OpenAI-compatible endpoint: what comes before /chat/completions.")
]
_ModelName = Annotated[str, typer.Option(help="The model's name at the endpoint.")]
_Key = Annotated[str, typer.Option("--llm-key", envvar="EMBOMATRIX_LLM_KEY", help="Key of the endpoint.")]
_Baseline = Annotated[
    BaselineName | None, typer.Option(help="A baseline that needs no model.", show_default=False)
]
_Answers = Annotated[
    Path | None, typer.Option(help="Judge the stored answers of an evaluation; asks nobody.")
]
_Bench = Annotated[
    str,
    typer.Option(help="eai-native, eai, internal-verified, a dataset folder, or a file of task records."),
]
_Split = Annotated[str, typer.Option(help="heldout, train or all; else heldout where the dataset has any.")]
_Profile = Annotated[
    Profile,
    typer.Option(help="paper: tasks that need one of the household's three skills more count as failed."),
]
_Tasks = Annotated[int | None, typer.Option(min=1, help="The first so many tasks only.")]
_Samples = Annotated[int, typer.Option(min=1, max=MOST_SAMPLES, help="Plans of each task.")]
_Temperature = Annotated[float, typer.Option(min=0, help="0 takes the likeliest plan.")]
_Seed = Annotated[int, typer.Option(min=0, help="Seed of sampling and of execution.")]
_MaxTokens = Annotated[int | None, typer.Option(min=1, help="Tokens of an answer at most.")]
_Codec = Annotated[
    Codec | None,
    typer.Option(
        help="How a language model writes plans: json or lines. Default: as it was taught here, else json."
    ),
]
_Concurrent = Annotated[int, typer.Option(min=1, help="Questions under way at the endpoint.")]
_Attempts = Annotated[int, typer.Option(min=1, help="Attempts at a question, with waits between.")]
_Manager = Annotated[
    str,
    typer.Option(
        help="HOST:PORT of a manager that executes; else this machine.", envvar="EMBOMATRIX_MANAGER"
    ),
]
_Token = Annotated[str, typer.Option(help="Token of the trainer role, or @FILE.", envvar="EMBOMATRIX_TOKEN")]
_Ca = Annotated[
    Path | None, typer.Option(help="The ca.pem of a manager that serves by TLS.", envvar="EMBOMATRIX_CA")
]
_Jobs = Annotated[int | None, typer.Option(min=1, help="Simulator processes without a manager.")]
_Out = Annotated[
    Path | None, typer.Option(help=f"Folder of answers and report; else {DEFAULT_OUT}/BENCH-MODEL.")
]
_Beside = Annotated[
    list[Path] | None, typer.Option(help="A report.json of the same tasks, as a row beside. Repeatable.")
]
_Threads = Annotated[int | None, typer.Option(min=1, help="Threads of torch.")]
_Device = Annotated[str, typer.Option(help="torch device of --model: cpu, cuda.")]


def evaluate(
    model: _Model = "",
    endpoint: _Endpoint = "",
    model_name: _ModelName = "",
    key: _Key = "",
    baseline: _Baseline = None,
    answers: _Answers = None,
    bench: _Bench = "",
    split: _Split = "",
    profile: _Profile = Profile.HOUSEHOLD,
    tasks: _Tasks = None,
    samples: _Samples = DEFAULT_SAMPLES,
    temperature: _Temperature = 1.0,
    seed: _Seed = 0,
    max_tokens: _MaxTokens = None,
    codec: _Codec = None,
    concurrent: _Concurrent = 8,
    attempts: _Attempts = 6,
    manager: _Manager = "",
    token: _Token = "",
    ca: _Ca = None,
    jobs: _Jobs = None,
    out: _Out = None,
    beside: _Beside = None,
    threads: _Threads = None,
    device: _Device = "cpu",
) -> None:
    """Measure a model, an endpoint or a baseline: success by category with intervals, and why plans fail.

    Answers are kept as they come: the same command goes on where an earlier one ended.
    """
    with _problems_shown():
        _check((model, endpoint, baseline, answers), bench, in_part=bool(split or tasks))
        if answers is not None:
            _judge_stored(answers, bench, out, ExecutionTarget(manager, token, ca, jobs), beside or [])
            return
        chosen = Chosen(model, endpoint, baseline, model_name, key, concurrent, attempts, threads, device)
        how = Questions(samples, temperature, seed, max_tokens, codec, profile)
        with _exam(
            ExecutionTarget(manager, token, ca, jobs), bench or DEFAULT_BENCH, split, tasks, profile
        ) as exam:
            _measure(exam, chosen, how, out, beside or [])


def _check(asked: Sequence[object], bench: str, *, in_part: bool) -> None:
    """Raises TrainerError unless exactly one may answer, and what is measured in part may be."""
    if sum(map(bool, asked)) != 1:
        raise TrainerError("expected one of --model, --endpoint, --baseline and --answers: give one of them")
    if bench == NATIVE and in_part:
        raise TrainerError(f"{NATIVE} is measured as a whole: leave out --split and --tasks")


def _measure(exam: Exam, chosen: Chosen, how: Questions, out: Path | None, beside: Sequence[Path]) -> None:
    """Ask, judge, and write the report."""
    label = chosen.model or chosen.model_name or str(chosen.baseline)
    folder = out or DEFAULT_OUT / _file_name(f"{Path(exam.name).name}-{label}")
    rows = [read_row(path, exam.digest) for path in beside]
    setup, given = _ask(exam, asked_of(exam, chosen, how, folder), how, folder)
    _judge(exam, setup, given, folder, rows)


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


@contextlib.contextmanager
def _exam(
    place: ExecutionTarget, named: str, split: str, limit: int | None, profile: Profile
) -> Iterator[Exam]:
    """The benchmark of this name, ready to ask and to judge."""
    if named == NATIVE:
        from embomatrix.trainer.eai.environment import JudgeEnvironment
        from embomatrix.trainer.eai.judge import NativeJudge

        with NativeJudge(JudgeEnvironment.find()) as judge:
            yield NativeExam(judge)
        return
    bench = find_benchmark(named, split, limit, profile)
    yield WorldExam(bench, place.executor(bench))


def _ask(
    exam: Exam, asked: EvaluationSubject, how: Questions, folder: Path
) -> tuple[EvaluationSetup, tuple[Answer, ...]]:
    """Fill the answer sheet."""
    questions = exam.questions(asked.codec, asked.rows)
    setup = EvaluationSetup(
        bench=exam.name,
        bench_digest=exam.digest,
        split=exam.split,
        tasks=len(exam.task_ids),
        model=asked.label,
        codec=asked.codec.value if isinstance(exam, WorldExam) else EAI_CODEC,
        rows=asked.rows,
        samples=how.samples,
        temperature=how.temperature,
        max_tokens=asked.max_tokens,
        seed=how.seed,
        questions=questions_digest(questions),
        by_rule=exam.by_rule,
        profile=how.profile.value,
    )
    began_s = time.monotonic()
    with AnswerSheet(folder / FILE, setup) as sheet:
        if len(sheet):
            console.print(f"{len(sheet)} answers are there already")
        with _bar("answers") as report:
            asked.asker.ask(questions, sheet, report)
        given = sheet.ordered(exam.task_ids)
    console.print(f"{len(given)} answers in {time.monotonic() - began_s:.1f} s: {folder / FILE}")
    return setup, given


def _judge_stored(
    path: Path, bench: str, out: Path | None, place: ExecutionTarget, beside: Sequence[Path]
) -> None:
    setup, stored = read_answers(path)
    with _exam(place, bench or setup.bench, setup.split, setup.tasks, _profile(setup, path)) as exam:
        if exam.digest != setup.bench_digest:
            raise TrainerError(
                f"{path} answers other tasks than {bench or setup.bench} holds now (digest {setup.bench_digest[:19]}…, now "
                f"{exam.digest[:19]}…): pass the benchmark that was asked with --bench"
            )
        check_expected(stored, exam.task_ids, setup, path)
        given = ordered(stored, exam.task_ids, setup.samples)
        asked_for = len(exam.task_ids) * setup.samples
        if len(given) < asked_for:
            missing = asked_for - len(given)
            console.print(f"{missing} of {asked_for} answers are missing: figures are over the others")
        _judge(exam, setup, given, out or path.parent, [read_row(row, exam.digest) for row in beside])


def _profile(setup: EvaluationSetup, path: Path) -> Profile:
    if setup.profile not in set(Profile):
        raise TrainerError(
            f"{path} names the unknown profile {setup.profile!r}: expected {' or '.join(Profile)}"
        )
    return Profile(setup.profile)


def _judge(
    exam: Exam, setup: EvaluationSetup, given: Sequence[Answer], folder: Path, rows: Sequence[ScoreRow]
) -> None:
    began_s = time.monotonic()
    with _bar("plans judged") as report:
        marked = exam.judge(setup, given, report)
    value = report_of(setup, marked)
    text = text_report(value, rows)
    _write(folder / "report.json", json.dumps(value, indent=1) + "\n")
    _write(folder / "report.txt", text)
    _write(folder / "report.html", evaluation_page(value, marked.pictures, rows))
    console.print(text)
    console.print(f"judged in {time.monotonic() - began_s:.1f} s: {folder / 'report.html'}, .json, .txt")


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
