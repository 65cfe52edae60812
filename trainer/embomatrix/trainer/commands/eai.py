"""`embomatrix eai`: install EAI's judge, and judge files of answers."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from embomatrix.host.failure import fail, unwritable
from embomatrix.host.own_files import prepare_output
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.eai.environment import JudgeEnvironment, default_folder, install
from embomatrix.trainer.eai.judge import NativeJudge
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)
console = Console(highlight=False, markup=False, soft_wrap=True)


@app.callback()
def eai() -> None:
    """Install EAI's judge, and judge files of answers."""


@app.command("install")
def install_command(
    folder: Annotated[
        Path | None,
        typer.Option(help="Installation folder. Default: $EMBOMATRIX_EAI, or a folder in your cache."),
    ] = None,
) -> None:
    """Download EAI's published judge (27 MB) into its own virtual environment (150 MB), for `eval --bench eai-native`."""
    try:
        found = install(folder, console.print)
    except TrainerError as error:
        fail("eai install", str(error))
    console.print(f"EAI's judge is installed in {found.folder}")
    console.print(f"import its tasks: embomatrix factory import --eai {found.package_root}")
    if folder is not None and folder != default_folder():
        console.print(f"set EMBOMATRIX_EAI={folder} to use it")


@app.command("judge")
def judge_command(
    answers: Annotated[
        Path, typer.Argument(help='JSON in EAI\'s own format: [{"identifier": …, "llm_output": …}].')
    ],
    out: Annotated[Path, typer.Argument(help="JSON file for the results.")],
) -> None:
    """Judge a file of answers in EAI's own format. For tables of results, use `embomatrix eval`."""
    prepare_output("eai judge", out)
    try:
        given = _read(answers)
        with NativeJudge(JudgeEnvironment.find()) as judge:
            known = {task.demo for task in judge.tasks()}
            results = [_result(judge, known, entry) for entry in given]
        write_whole(out, (json.dumps(results, indent=1) + "\n").encode("utf-8"))
    except OSError as error:
        fail("eai judge", unwritable(out, error))
    except TrainerError as error:
        fail("eai judge", str(error))
    counts = {
        name: sum(bool(entry[name]) for entry in results)
        for name in ("official", "exact", "executed", "lost")
    }
    console.print(
        f"{len(results)} answers: {', '.join(f'{count} {name}' for name, count in counts.items())}: {out}"
    )


def _read(path: Path) -> list[dict[str, str]]:
    try:
        value = parse_json(path.read_bytes())
        return [{name: str(entry[name]) for name in ("identifier", "llm_output")} for entry in value]
    except OSError as error:
        raise TrainerError(f"{path} can't be read ({error.strerror}): expected a JSON file") from error
    except (ValueError, KeyError, TypeError) as error:
        raise TrainerError(
            f'{path} is not an answer file of EAI ({error!r}): expected [{{"identifier": …, "llm_output": …}}, …]'
        ) from error


def _result(judge: NativeJudge, known: set[str], entry: dict[str, str]) -> dict[str, Any]:
    name = entry["identifier"]
    if name not in known:
        raise TrainerError(
            f"EAI's BEHAVIOR split has no task {name!r}: expected one of its {len(known)} identifiers"
        )
    found = judge.judge(name, entry["llm_output"])
    if found is None:
        return {"identifier": name, "official": False, "exact": False, "executed": False, "lost": True}
    return {"identifier": name, **asdict(found), "lost": False}
