"""`embomatrix eval`: success of a model, an endpoint or a baseline on a benchmark.

Answers are stored, so the report can be made again. torch is imported only for a policy in this process, the physics
engine only without a manager.
"""

import contextlib
import functools
import json
import logging
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from embomatrix.host.failure import INTERRUPTED, fail, unwritable
from embomatrix.host.limits import usable_cores
from embomatrix.host.own_files import is_own, prepare_output
from embomatrix.host.printable import printable
from embomatrix.rpc.options import Ca, Token, add_settings, given_options
from embomatrix.skills.parse import plan_to_json
from embomatrix.skills.prompt import Codec
from embomatrix.starter.options import DATASET_VARIABLE, DEFAULT_DATASET, default_dataset
from embomatrix.trainer.cluster.executor import Executor
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import read_toml, settings_error
from embomatrix.trainer.eai.exam import CODEC as EAI_CODEC
from embomatrix.trainer.eai.exam import NAME as NATIVE
from embomatrix.trainer.eai.exam import NativeExam
from embomatrix.trainer.evaluation.answer_sources import (
    OnProgress,
    ask_endpoint,
    ask_policy,
    ask_script,
    questions_digest,
)
from embomatrix.trainer.evaluation.answers import (
    FILE,
    HEADER,
    MOST_SAMPLES,
    Answer,
    AnswerSheet,
    EvaluationSetup,
    check_expected,
    ordered,
    read_answers,
)
from embomatrix.trainer.evaluation.baselines import PLANNERS, SCRIPTS, BaselineName, fitted_scripts
from embomatrix.trainer.evaluation.benchmark import Benchmark, find_benchmark
from embomatrix.trainer.evaluation.exam import Question, WorldExam
from embomatrix.trainer.evaluation.page import evaluation_page
from embomatrix.trainer.evaluation.table import ScoreRow, read_row, report_of, text_report
from embomatrix.trainer.policy.limits import (
    ANSWER_TOKENS,
    Limits,
    Ruler,
    check_context,
    expressibility,
    room_for,
    sentence_about,
)
from embomatrix.world.dataset import Dataset, DatasetError
from embomatrix.world.task import MAX_TABLE, Profile
from embomatrix.world.whole_file import write_whole

DEFAULT_OUT: Final = Path("runs/eval")
REPORTS: Final = ("report.json", "report.txt", "report.html")
REPORT_MARK: Final = b'"report": '
"""Part of the first bytes of each report.json."""
MAX_TOKENS: Final = "max_tokens"
"""Name of the setting that limits an answer."""
Exam = WorldExam | NativeExam
console = Console(highlight=False, markup=False, soft_wrap=True)


class EvalSettings(BaseModel):
    """Settings of an evaluation. Options of the command override those of the TOML file."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)
    samples: int = Field(10, ge=1, le=MOST_SAMPLES)
    """Plans per task."""
    temperature: float = Field(1.0, ge=0)
    """Sampling temperature. 0: greedy."""
    seed: int = Field(0, ge=0)
    """Seed of sampling and execution."""
    tasks: int | None = Field(None, ge=1)
    """Evaluate only the first tasks."""
    max_tokens: int | None = Field(None, ge=1)
    """Maximum tokens of an answer. Default: as the model was trained here, 1024 for all other models and endpoints."""
    codec: Codec | None = None
    """Plan format of a language model. Default: as it was trained here, else JSON."""
    profile: Profile = Profile.HOUSEHOLD
    """paper: tasks that need another household skill count as failed."""
    concurrent: int = Field(8, ge=1)
    """Concurrent requests to the endpoint."""
    attempts: int = Field(6, ge=1)
    """Attempts per request, with waits between."""
    jobs: int | None = Field(None, ge=1)
    """Simulator processes without a manager. Default: one per core."""
    threads: int | None = Field(None, ge=1)
    """torch threads."""
    device: str = "cpu"
    """torch device of a local model: cpu or cuda."""


@dataclass(frozen=True, slots=True)
class Subject:
    """Model, endpoint or baseline that is ready to answer, with its codec, maximum table rows and maximum tokens.

    ``ruler`` measures prompts and plans for it, None for a baseline.
    """

    ask: Callable[[Sequence[Question], AnswerSheet, OnProgress], None]
    codec: Codec = Codec.JSON
    rows: int = MAX_TABLE
    max_tokens: int = 1
    ruler: Ruler | None = None


def _option(panel: str, *names: str, **options: Any) -> Any:
    return typer.Option(*names, rich_help_panel=panel, show_default=False, **options)


_SUBJECT: Final = "Subject (exactly one of --model, --endpoint, --baseline, --answers)"
_BENCH: Final = "Benchmark"
_EXECUTION: Final = "Execution"
_OUTPUT: Final = "Output"


def evaluate(
    context: typer.Context,
    model: Annotated[
        str, _option(_SUBJECT, help="Checkpoint, or a Hugging Face model by name or folder.")
    ] = "",
    endpoint: Annotated[
        str, _option(_SUBJECT, help="URL of an OpenAI-compatible endpoint, before /chat/completions.")
    ] = "",
    model_name: Annotated[str, _option(_SUBJECT, help="Model name at the endpoint.")] = "",
    key: Annotated[
        str, _option(_SUBJECT, "--llm-key", envvar="EMBOMATRIX_LLM_KEY", help="API key of the endpoint.")
    ] = "",
    baseline: Annotated[BaselineName | None, _option(_SUBJECT, help="Baseline without a model.")] = None,
    training: Annotated[
        Path | None,
        _option(
            _SUBJECT,
            help="Dataset whose training tasks the baselines template and nearest learn from. Default: that of --bench.",
        ),
    ] = None,
    answers: Annotated[Path | None, _option(_SUBJECT, help="Stored answers to judge again.")] = None,
    bench: Annotated[
        str,
        _option(
            _BENCH,
            "--bench",
            "--dataset",
            help="eai-native, eai, internal-verified-2, the folder of a dataset, or a file of task records. "
            f"Default: ${DATASET_VARIABLE}, or {DEFAULT_DATASET}.",
        ),
    ] = "",
    split: Annotated[
        str, _option(_BENCH, help="heldout, train or all. Default: heldout if there is one.")
    ] = "",
    settings_file: Annotated[
        Path | None,
        _option(_BENCH, "--settings", help="TOML file with settings (docs/evaluation.md)."),
    ] = None,
    manager: Annotated[
        str,
        _option(
            _EXECUTION, envvar="EMBOMATRIX_MANAGER", help="HOST:PORT of a manager. Default: this machine."
        ),
    ] = "",
    token: Token = "",
    ca: Ca = None,
    out: Annotated[
        Path | None,
        _option(_OUTPUT, help=f"Folder of answers and report. Default: {DEFAULT_OUT}/BENCH-MODEL."),
    ] = None,
    beside: Annotated[
        list[Path] | None,
        _option(_OUTPUT, help="A report.json of the same tasks, as another row. Repeatable."),
    ] = None,
    **_: object,
) -> None:
    """Evaluate a model, an endpoint or a baseline: success by category with intervals, and causes of failure.

    Answers are stored as they arrive: the same command continues an interrupted evaluation.
    """
    with _report_errors():
        if sum(map(bool, (model, endpoint, baseline, answers))) != 1:
            raise TrainerError(
                "expected one of --model, --endpoint, --baseline and --answers: give one of them"
            )
        settings = read_eval_settings(settings_file, given_options(context))
        open_executor = functools.partial(_executor, manager, token, ca, settings.jobs)
        if answers is not None:
            _judge_stored(answers, bench, out, open_executor, beside or [])
            return
        if bench == NATIVE and (split or settings.tasks):
            raise TrainerError(f"{NATIVE} is measured as a whole: leave out --split and --tasks")
        if training is not None and baseline not in SCRIPTS:
            raise TrainerError(f"--training is for the baselines {' and '.join(SCRIPTS)}: leave it out")
        label = model or model_name or str(baseline)
        with _exam(
            open_executor, bench or str(default_dataset()), split, settings.tasks, settings.profile
        ) as exam:
            folder = out or DEFAULT_OUT / _file_name(f"{Path(exam.name).name}-{label}")
            _check_reports(folder)
            rows = [read_row(path, exam.digest) for path in beside or []]
            if baseline is not None:
                subject = Subject(functools.partial(ask_script, _baseline(exam, baseline, training)))
            elif model:
                subject = _policy(exam, model, settings)
            else:
                subject = _endpoint(endpoint, model_name, key, settings, folder)
            _prepare_reports(folder)
            setup, given = _ask(exam, subject, label, settings, folder)
            _judge(exam, setup, given, folder, rows)


add_settings(
    evaluate,
    EvalSettings,
    skip=("concurrent", "attempts"),
    panel="Settings (also in the file of --settings)",
)


def read_eval_settings(path: Path | None, options: dict[str, Any]) -> EvalSettings:
    """Merge a TOML file and those of the given options that are settings. Raises TrainerError."""
    values = {} if path is None else read_toml(path)
    given = {name: value for name, value in options.items() if name in EvalSettings.model_fields}
    try:
        return EvalSettings.model_validate(values | given)
    except ValidationError as error:
        raise settings_error(error) from error


@contextlib.contextmanager
def _report_errors() -> Iterator[None]:
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
            f"interrupted: answers so far are kept in {FILE}; the same command continues from there",
            INTERRUPTED,
        )


def _executor(manager: str, token: str, ca: Path | None, jobs: int | None, bench: Benchmark) -> Executor:
    """Executor on the manager's cluster, or in processes of this machine."""
    if not manager:
        from embomatrix.worker.slots.rollout_pool import RolloutPool

        return RolloutPool(bench.folder, jobs or usable_cores())
    from embomatrix.rpc.client import ClusterClient
    from embomatrix.rpc.trust import read_ca, read_token
    from embomatrix.trainer.cluster.executor import ClusterExecutor

    connect = functools.partial(ClusterClient, manager, read_token(token), ca=read_ca(ca))
    return ClusterExecutor(connect, bench.dataset.bundle_bytes)


@contextlib.contextmanager
def _exam(
    open_executor: Callable[[Benchmark], Executor], name: str, split: str, limit: int | None, profile: Profile
) -> Iterator[Exam]:
    if name == NATIVE:
        from embomatrix.trainer.eai.environment import JudgeEnvironment
        from embomatrix.trainer.eai.judge import NativeJudge

        with NativeJudge(JudgeEnvironment.find()) as judge:
            yield NativeExam(judge)
        return
    bench = find_benchmark(name, split, limit, profile)
    yield WorldExam(bench, open_executor(bench))


def _policy(exam: Exam, model: str, settings: EvalSettings) -> Subject:
    """Load the model. Raises TrainerError."""
    from embomatrix.trainer.evaluation.models import load_model

    policy, trained = load_model(model, settings.codec, threads=settings.threads, device=settings.device)
    if isinstance(exam, NativeExam) and policy.codec is Codec.NAMES:
        raise TrainerError(
            f"{model} is a word-level policy, which can't read {NATIVE}'s prompts: pass another model"
        )
    ask, ruler = functools.partial(ask_policy, policy), Ruler.of_policy(policy)
    prompts = {each.task_id: each.prompt for each in exam.questions(policy.codec, trained.prompt.rows)}
    max_tokens = settings.max_tokens or room_for(trained.grpo.max_new, prompts, ruler)
    check_context(prompts, max_tokens, ruler, MAX_TOKENS)
    return Subject(ask, policy.codec, trained.prompt.rows, max_tokens, ruler)


def _endpoint(url: str, model_name: str, key: str, settings: EvalSettings, folder: Path) -> Subject:
    if not model_name:
        raise TrainerError("the endpoint's model has no name: pass --model-name as the endpoint calls it")
    if settings.codec is Codec.NAMES:
        raise TrainerError("the codec `names` is for word-level policies: pass --codec json or lines")
    from embomatrix.llm.endpoint import Endpoint, EndpointLimits

    limits = EndpointLimits(attempts=settings.attempts, concurrent=settings.concurrent)
    connect = functools.partial(Endpoint, url, model_name, api_key=key, limits=limits)
    ask = functools.partial(ask_endpoint, connect, folder / "ledger.jsonl")
    codec, max_tokens = settings.codec or Codec.JSON, settings.max_tokens or ANSWER_TOKENS
    return Subject(ask, codec, max_tokens=max_tokens, ruler=Ruler.of_endpoint(codec))


def _baseline(
    exam: Exam, name: BaselineName, training: Path | None
) -> Callable[[str, np.random.Generator], str]:
    """Function that writes a baseline's answer: its plan in our world, the published human plan in EAI's."""
    if isinstance(exam, NativeExam):
        if name is not BaselineName.HUMAN:
            raise TrainerError(
                f"the baseline `{name}` is for our own tasks: on {NATIVE} pass --baseline human"
            )
        return lambda task_id, rng: exam.human(task_id)
    if name is BaselineName.HUMAN:
        raise TrainerError(f"the human plans are of {NATIVE}: pass --bench {NATIVE}, or --baseline oracle")
    bench, tasks = exam.bench, exam.bench.tasks
    if name in SCRIPTS:
        scripts = fitted_scripts(name, bench.training if training is None else _training_tasks(training))
        return lambda task_id, rng: json.dumps(plan_to_json(scripts.plan(task_id, tasks[task_id].situation)))
    plan = PLANNERS[name]
    return lambda task_id, rng: json.dumps(plan_to_json(plan(tasks[task_id], rng)))


def _training_tasks(folder: Path) -> Dataset:
    try:
        return Dataset.load(folder)
    except DatasetError as error:
        raise TrainerError(str(error)) from error


def _show_limits(exam: Exam, subject: Subject) -> None:
    """Print the share of tasks that the subject can't express. EAI's own prompts have no oracle plans."""
    if subject.ruler is None or isinstance(exam, NativeExam):
        return
    limits = Limits(subject.rows, subject.max_tokens)
    tasks = tuple(exam.bench.tasks.values())
    found = expressibility(tasks, limits, subject.ruler, refused=exam.by_rule)
    console.print(sentence_about(found, f"tasks of {exam.name}", limits, MAX_TOKENS))


def _ask(
    exam: Exam, subject: Subject, label: str, settings: EvalSettings, folder: Path
) -> tuple[EvaluationSetup, tuple[Answer, ...]]:
    """Collect the missing answers."""
    _show_limits(exam, subject)
    questions = exam.questions(subject.codec, subject.rows)
    setup = EvaluationSetup(
        bench=exam.name,
        bench_digest=exam.digest,
        split=exam.split,
        tasks=len(exam.task_ids),
        model=label,
        codec=subject.codec.value if isinstance(exam, WorldExam) else EAI_CODEC,
        rows=subject.rows,
        samples=settings.samples,
        temperature=settings.temperature,
        max_tokens=subject.max_tokens,
        seed=settings.seed,
        questions=questions_digest(questions),
        by_rule=exam.by_rule,
        profile=settings.profile.value,
    )
    began_s = time.monotonic()
    with AnswerSheet(folder / FILE, setup) as sheet:
        if len(sheet):
            console.print(f"{len(sheet)} answers are already stored")
        with _bar("answers") as on_progress:
            subject.ask(questions, sheet, on_progress)
        given = sheet.ordered(exam.task_ids)
    console.print(f"{len(given)} answers in {time.monotonic() - began_s:.1f} s: {folder / FILE}")
    return setup, given


def _judge_stored(
    path: Path,
    bench: str,
    out: Path | None,
    open_executor: Callable[[Benchmark], Executor],
    beside: Sequence[Path],
) -> None:
    setup, stored = read_answers(path)
    if setup.profile not in set(Profile):
        raise TrainerError(
            f"{path} names the unknown profile {setup.profile!r}: expected {' or '.join(Profile)}"
        )
    with _exam(open_executor, bench or setup.bench, setup.split, setup.tasks, Profile(setup.profile)) as exam:
        if exam.digest != setup.bench_digest:
            raise TrainerError(
                f"{path} answers other tasks than {bench or setup.bench} holds now (digest {setup.bench_digest[:19]}…, now "
                f"{exam.digest[:19]}…): pass the benchmark of the answers with --bench"
            )
        check_expected(stored, exam.task_ids, setup, path)
        _check_reports(out or path.parent)
        given = ordered(stored, exam.task_ids, setup.samples)
        expected = len(exam.task_ids) * setup.samples
        if len(given) < expected:
            missing = expected - len(given)
            console.print(f"{missing} of {expected} answers are missing: the figures leave them out")
        _prepare_reports(out or path.parent)
        _judge(exam, setup, given, out or path.parent, [read_row(row, exam.digest) for row in beside])


def _check_reports(folder: Path) -> None:
    """Raise TrainerError if a report would replace a file that no evaluation wrote."""
    if is_own(folder / FILE, HEADER) or is_own(folder / REPORTS[0], REPORT_MARK):
        return
    if found := [folder / name for name in REPORTS if (folder / name).exists()]:
        raise TrainerError(
            f"{found[0]} was not written by an evaluation: pass another --out, or move it away"
        )


def _prepare_reports(folder: Path) -> None:
    """Make the folder of the reports once nothing else can be refused, or refuse it before the work begins."""
    prepare_output("eval", *(folder / name for name in REPORTS))


def _judge(
    exam: Exam, setup: EvaluationSetup, given: Sequence[Answer], folder: Path, rows: Sequence[ScoreRow]
) -> None:
    began_s = time.monotonic()
    with _bar("judged plans") as on_progress:
        result = exam.judge(setup, given, on_progress)
    report = report_of(setup, result)
    text = printable(text_report(report, rows), lines=True)
    texts = (json.dumps(report, indent=1) + "\n", text, evaluation_page(report, result.pictures, rows))
    for name, content in zip(REPORTS, texts, strict=True):
        _write(folder / name, content)
    console.print(text)
    console.print(f"judged in {time.monotonic() - began_s:.1f} s: {folder / 'report.html'}, .json, .txt")


def _write(path: Path, text: str) -> None:
    try:
        write_whole(path, text.encode("utf-8"))
    except OSError as error:
        raise TrainerError(unwritable(path, error)) from error


@contextlib.contextmanager
def _bar(name: str) -> Iterator[Callable[[int, int], None]]:
    columns: Any = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        bar = progress.add_task(name, total=None)
        yield lambda done, total: progress.update(bar, completed=done, total=total)


def _file_name(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9._-]+", "-", text).strip("-.") or "model"
