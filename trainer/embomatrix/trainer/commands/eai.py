"""`embomatrix eai`: install EAI's judge, and judge answers that others collected."""

from __future__ import annotations

import json
from pathlib import Path  # noqa: TC003  typer reads the annotations when the command runs
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.eai.environment import JudgeEnvironment, default_folder, install
from embomatrix.trainer.eai.judge import NativeJudge

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)
console = Console(highlight=False, markup=False, soft_wrap=True)


@app.callback()
def eai() -> None:
    """Install EAI's judge, and judge answers that others collected."""


@app.command("install")
def install_command(
    folder: Annotated[
        Path | None, typer.Option(help="Where; else $EMBOMATRIX_EAI, else a folder in your cache.")
    ] = None,
) -> None:
    """Fetch EAI's published judge (27 MB) into a virtual environment of its own (150 MB). `eval --bench eai-native` uses it."""
    try:
        found = install(folder, console.print)
    except TrainerError as error:
        _leave("install", error)
    console.print(f"EAI's judge is in {found.folder}")
    console.print(f"its tasks for our world: embomatrix factory import --eai {found.package_root}")
    if folder is not None and folder != default_folder():
        console.print(f"let EMBOMATRIX_EAI={folder} name it")


@app.command("judge")
def judge_command(
    answers: Annotated[
        Path, typer.Argument(help='JSON as EAI\'s own tools take it: [{"identifier": …, "llm_output": …}].')
    ],
    out: Annotated[Path, typer.Argument(help="Where the results go, as JSON.")],
) -> None:
    """Judge a file of answers in EAI's own format, each by itself. `embomatrix eval` makes tables of what it asked."""
    try:
        given = _read(answers)
        with NativeJudge(JudgeEnvironment.find()) as judge:
            known = {task.demo for task in judge.tasks()}
            results = [_result(judge, known, entry) for entry in given]
        out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        _leave("judge", TrainerError(f"{out} can't be written ({error.strerror}): name another file"))
    except TrainerError as error:
        _leave("judge", error)
    told = {
        name: sum(bool(entry[name]) for entry in results)
        for name in ("official", "exact", "executed", "lost")
    }
    console.print(
        f"{len(results)} answers: {', '.join(f'{count} {name}' for name, count in told.items())}: {out}"
    )


def _read(path: Path) -> list[dict[str, str]]:
    try:
        value = json.loads(path.read_bytes())
        return [{name: str(entry[name]) for name in ("identifier", "llm_output")} for entry in value]
    except OSError as error:
        raise TrainerError(f"{path} can't be read ({error.strerror}): expected a JSON file") from error
    except (ValueError, KeyError, TypeError) as error:
        raise TrainerError(
            f'{path} holds no answers of EAI ({error!r}): expected [{{"identifier": …, "llm_output": …}}, …]'
        ) from error


def _result(judge: NativeJudge, known: set[str], entry: dict[str, str]) -> dict[str, Any]:
    name = entry["identifier"]
    if name not in known:
        raise TrainerError(
            f"there is no task {name!r} in EAI's BEHAVIOR split: expected one of its {len(known)}"
        )
    found = judge.judge(name, entry["llm_output"])
    if found is None:
        return {"identifier": name, "official": False, "exact": False, "executed": False, "lost": True}
    return {
        "identifier": name,
        "official": found.official,
        "exact": found.exact,
        "executed": found.executed,
        "lost": False,
        "goals": list(found.goals),
        "errors": dict(found.errors),
    }


def _leave(command: str, error: TrainerError) -> NoReturn:
    Console(stderr=True, soft_wrap=True).print(
        f"embomatrix eai {command}: {error}", highlight=False, markup=False
    )
    raise typer.Exit(2) from None
