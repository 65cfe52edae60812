"""Every command that README and the documents print exists, with its options and the values of its choices."""

import importlib.metadata
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

ROOT = Path(__file__).parents[3]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def commands_in(text: str) -> Iterator[str]:
    """Yield the command lines of code blocks and of code within sentences, without comments and continuations."""
    for block in re.findall(r"```[a-z]*\n(.*?)```", text, re.DOTALL):
        for line in block.replace("\\\n", " ").splitlines():
            if found := re.match(r"\s*(?:\$ )?(?:[A-Z_]+=\S+ )*(embomatrix .*)", line):
                yield found[1]
    for found in re.findall(r"(?<!`)`(embomatrix [^`]+)`", re.sub(r"```.*?```", "", text, flags=re.DOTALL)):
        yield found.replace("\n", " ")


def command_named(name: str) -> Any:
    """Return a subcommand of `embomatrix`, None if there is none of this name."""
    found = [
        each for each in importlib.metadata.entry_points(group="embomatrix.commands") if each.name == name
    ]
    if not found:
        return None
    loaded = found[0].load()
    if isinstance(loaded, typer.Typer):
        return typer.main.get_command(loaded)
    app = typer.Typer()
    app.command()(loaded)
    return typer.main.get_command(app)


def problems_of(line: str) -> list[str]:
    """Return what a printed command names that does not exist."""
    try:
        words = shlex.split(line.replace("…", " ").replace("...", " "), comments=True)[1:]
    except ValueError as error:
        return [str(error)]
    words = [word for word in re.split(r"[|;&>]", " ".join(map(shlex.quote, words)))[0].split() if word]
    if not words or words[0].startswith("-"):
        return []
    alternatives = words[0].split("|")
    command = command_named(alternatives[0])
    if command is None:
        return [f"there is no command {words[0]!r}"]
    path, rest = words[0], words[1:]
    while (known := getattr(command, "commands", None)) and rest and not rest[0].startswith("-"):
        if not re.fullmatch(r"[a-z][a-z0-9-]*", rest[0]):
            return []  # a placeholder such as PART
        if rest[0] not in known:
            return [f"{path} has no command {rest[0]!r}"]
        path, command, rest = rest[0], known[rest[0]], rest[1:]
    return [
        problem for at, word in enumerate(rest) if (problem := option_problem(command, word, rest[at + 1 :]))
    ]


def option_problem(command: Any, word: str, after: list[str]) -> str:
    """Return the problem of one word of a command line, "" for none."""
    name, _, value = word.partition("=")
    if not re.fullmatch(r"--[a-z][\w-]*", name):
        return ""
    options = {option: each for each in command.params for option in (*each.opts, *each.secondary_opts)}
    if name == "--help":
        return ""
    if name not in options:
        return f"{command.name} has no option {name}"
    option = options[name]
    kind = getattr(option, "type_descriptor", None) or option.type  # by the version of typer
    choices = [str(getattr(choice, "value", choice)) for choice in getattr(kind, "choices", None) or ()]
    given = value or next(iter(after), "")
    if choices and re.fullmatch(r"[a-z][\w-]*", given) and given not in choices:
        return f"{name} takes {', '.join(choices)}, not {given}"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_printed_commands_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    found = {line: problems for line in commands_in(text) if (problems := problems_of(line))}
    assert not found


def test_wrong_commands_are_found() -> None:
    assert problems_of("embomatrix plaz TASK") == ["there is no command 'plaz'"]
    assert problems_of("embomatrix factory lists build") == ["factory has no command 'lists'"]
    assert problems_of("embomatrix play TASK --orcale") == ["play has no option --orcale"]
    assert "not fast" in problems_of("embomatrix play TASK --mode fast")[0]
    assert not problems_of('embomatrix play "put it there" --policy shipped | tail')
    assert sum(len(list(commands_in(page.read_text(encoding="utf-8")))) for page in PAGES) > 150
