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
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from embomatrix.cli.evaluated_models import (
    MAX_TOKENS,
    EvaluatedModel,
    evaluated_endpoint,
    evaluated_policy,
    playing_baseline,
    written_baseline,
)
from embomatrix.cli.evaluation_settings import Cluster, EvalSettings, Exam, world_exam
from embomatrix.envs.rules import Visibility
from embomatrix.host.failure import INTERRUPTED, fail, unwritable
from embomatrix.host.own_files import is_own, prepare_output
from embomatrix.host.printable import printable
from embomatrix.rpc.options import Ca, Token, add_settings, given_options
from embomatrix.starter.options import DATASET_VARIABLE, DEFAULT_DATASET, default_dataset
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.config.settings import read_toml, settings_error
from embomatrix.trainer.eai.exam import CODEC as EAI_CODEC
from embomatrix.trainer.eai.exam import NAME as NATIVE
from embomatrix.trainer.eai.exam import NativeExam
from embomatrix.trainer.evaluation.answer_sources import (
    ask_script,
    questions_digest,
)
from embomatrix.trainer.evaluation.answers import (
    FILE,
    HEADER,
    Answer,
    AnswerSheet,
    EvaluationSetup,
    check_expected,
    ordered,
    read_answers,
)
from embomatrix.trainer.evaluation.baselines import SCRIPTS, BaselineName
from embomatrix.trainer.evaluation.benchmark import Benchmark, find_benchmark
from embomatrix.trainer.evaluation.episodes import (
    EpisodeExam,
)
from embomatrix.trainer.evaluation.exam import WorldExam
from embomatrix.trainer.evaluation.page import evaluation_page
from embomatrix.trainer.evaluation.table import ScoreRow, read_row, report_of, text_report
from embomatrix.trainer.policy.limits import (
    Limits,
    expressibility,
    sentence_about,
)
from embomatrix.world.task import Profile
from embomatrix.world.whole_file import write_whole

DEFAULT_OUT: Final = Path("runs/eval")
REPORTS: Final = ("report.json", "report.txt", "report.html")
REPORT_MARK: Final = b'"report": '
"""Part of the first bytes of each report.json."""
console = Console(highlight=False, markup=False, soft_wrap=True)


def _option(panel: str, *names: str, **options: Any) -> Any:
    return typer.Option(*names, rich_help_panel=panel, show_default=False, **options)


_EVALUATED: Final = "What is evaluated (exactly one of --model, --endpoint, --baseline, --answers)"
_BENCH: Final = "Benchmark"
_EXECUTION: Final = "Execution"
_OUTPUT: Final = "Output"


def evaluate(
    context: typer.Context,
    model: Annotated[
        str, _option(_EVALUATED, help="Checkpoint, or a Hugging Face model by name or folder.")
    ] = "",
    endpoint: Annotated[
        str, _option(_EVALUATED, help="URL of an OpenAI-compatible endpoint, before /chat/completions.")
    ] = "",
    model_name: Annotated[str, _option(_EVALUATED, help="Model name at the endpoint.")] = "",
    key: Annotated[
        str, _option(_EVALUATED, "--llm-key", envvar="EMBOMATRIX_LLM_KEY", help="API key of the endpoint.")
    ] = "",
    baseline: Annotated[BaselineName | None, _option(_EVALUATED, help="Baseline without a model.")] = None,
    training: Annotated[
        Path | None,
        _option(
            _EVALUATED,
            help="Dataset whose training tasks the baselines template and nearest learn from. Default: that of --bench.",
        ),
    ] = None,
    answers: Annotated[Path | None, _option(_EVALUATED, help="Stored answers to judge again.")] = None,
    bench: Annotated[
        str,
        _option(
            _BENCH,
            "--bench",
            "--dataset",
            help="starter, internal-verified-2, search, eai-native, eai, the folder of a dataset, or a file of task records. "
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
        cluster = Cluster(manager, token, ca, settings.jobs)
        if answers is not None:
            _judge_stored(answers, bench, out, cluster, beside or [])
            return
        if bench == NATIVE and (split or settings.tasks):
            raise TrainerError(f"{NATIVE} is measured as a whole: leave out --split and --tasks")
        if training is not None and baseline not in SCRIPTS:
            raise TrainerError(f"--training is for the baselines {' and '.join(SCRIPTS)}: leave it out")
        label = model or model_name or str(baseline)
        if settings.visibility is Visibility.SEEN and not settings.interactive:
            raise TrainerError("--visibility seen is for episodes: pass --interactive, or leave it out")
        if settings.interactive and bench == NATIVE:
            raise TrainerError(
                f"{NATIVE} judges whole plans: leave out --interactive, or pass another --bench"
            )
        opened = functools.partial(world_exam, cluster, interactive=settings.interactive)
        with _exam(opened, bench or str(default_dataset()), split, settings.tasks, settings.profile) as exam:
            folder = out or DEFAULT_OUT / _file_name(f"{Path(exam.name).name}-{label}")
            _check_reports(folder)
            rows = [read_row(path, exam.digest) for path in beside or []]
            if model:
                evaluated = evaluated_policy(exam, model, settings)
            elif baseline is None:
                evaluated = evaluated_endpoint(exam, endpoint, model_name, key, settings, folder)
            elif isinstance(exam, EpisodeExam):
                evaluated = playing_baseline(exam, baseline, settings.seed)
            else:
                evaluated = EvaluatedModel(
                    functools.partial(ask_script, written_baseline(exam, baseline, training))
                )
            _prepare_reports(folder)
            setup, given = _ask(exam, evaluated, label, settings, folder)
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


@contextlib.contextmanager
def _exam(
    opened: Callable[[Benchmark], WorldExam | EpisodeExam],
    name: str,
    split: str,
    limit: int | None,
    profile: Profile,
) -> Iterator[Exam]:
    if name == NATIVE:
        from embomatrix.trainer.eai.environment import JudgeEnvironment
        from embomatrix.trainer.eai.judge import NativeJudge

        with NativeJudge(JudgeEnvironment.find()) as judge:
            yield NativeExam(judge)
        return
    yield opened(find_benchmark(name, split, limit, profile))


def _show_limits(exam: Exam, evaluated: EvaluatedModel) -> None:
    """Print the share of tasks that the model can't express. EAI's own prompts have no oracle plans."""
    if evaluated.counter is None or isinstance(exam, NativeExam):
        return
    limits = Limits(evaluated.rows, evaluated.max_tokens)
    tasks = tuple(exam.bench.tasks.values())
    found = expressibility(tasks, limits, evaluated.counter, refused=exam.by_rule)
    console.print(sentence_about(found, f"tasks of {exam.name}", limits, MAX_TOKENS))


def _ask(
    exam: Exam, evaluated: EvaluatedModel, label: str, settings: EvalSettings, folder: Path
) -> tuple[EvaluationSetup, tuple[Answer, ...]]:
    """Collect the missing answers."""
    _show_limits(exam, evaluated)
    questions = exam.questions(evaluated.codec, evaluated.rows)
    setup = EvaluationSetup(
        bench=exam.name,
        bench_digest=exam.digest,
        split=exam.split,
        tasks=len(exam.task_ids),
        model=label,
        codec=EAI_CODEC if isinstance(exam, NativeExam) else evaluated.codec.value,
        rows=evaluated.rows,
        samples=settings.samples,
        temperature=settings.temperature,
        max_tokens=evaluated.max_tokens,
        seed=settings.seed,
        questions=questions_digest(questions),
        by_rule=exam.by_rule,
        profile=settings.profile.value,
        **_episodes_of(settings),
    )
    began_s = time.monotonic()
    with AnswerSheet(folder / FILE, setup) as sheet:
        if len(sheet):
            console.print(f"{len(sheet)} answers are already stored")
        with _bar("answers") as on_progress:
            evaluated.ask(questions, sheet, on_progress)
        given = sheet.ordered(exam.task_ids)
    console.print(f"{len(given)} answers in {time.monotonic() - began_s:.1f} s: {folder / FILE}")
    return setup, given


def _episodes_of(settings: EvalSettings) -> dict[str, Any]:
    """Fields of a setup about episodes."""
    if not settings.interactive:
        return {}
    return {
        "visibility": settings.visibility.value,
        "calls_factor": settings.calls_factor,
        "calls_more": settings.calls_more,
    }


def _judge_stored(path: Path, bench: str, out: Path | None, cluster: Cluster, beside: Sequence[Path]) -> None:
    setup, stored = read_answers(path)
    opened = functools.partial(world_exam, cluster, interactive=bool(setup.visibility))
    if setup.profile not in set(Profile):
        raise TrainerError(
            f"{path} names the unknown profile {setup.profile!r}: expected {' or '.join(Profile)}"
        )
    with _exam(opened, bench or setup.bench, setup.split, setup.tasks, Profile(setup.profile)) as exam:
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
