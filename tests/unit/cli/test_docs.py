"""Commands shown in the documentation exist with their options."""

import re
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
import typer

from embomatrix.cli.main import GROUP

ROOT = Path(__file__).parents[3]
PAGES = [
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "Makefile")),
    *sorted((ROOT / "docs").rglob("*.md")),
]
WORDS = {"COMMAND", "NAME", "--help"}
"""Placeholders, and options of every command."""


def shown(text: str) -> list[list[str]]:
    """Return commands at the start of a line, in backticks, or behind make's variable, as words."""
    lines = re.findall(r"^(?:\t\$\(BIN\)/)?embomatrix +([^#|\n]+)", text.replace("\\\n", " "), re.MULTILINE)
    quoted = re.findall(r"`embomatrix\s+([^`]+)`", text)
    return [found.split() for found in (*lines, *quoted)]


def target_of(words: list[str]) -> tuple[Any, list[str]]:
    """Return the command that the words name, and the remaining words."""
    points = {point.name: point for point in entry_points(group=GROUP)}
    assert words[0] in points, f"there is no `embomatrix {words[0]}`"
    target = points[words[0]].load()
    app = target if isinstance(target, typer.Typer) else typer.Typer(add_completion=False)
    if app is not target:
        app.command()(target)
    command, rest = typer.main.get_command(app), words[1:]
    while getattr(command, "commands", None) and rest and re.match(r"\w", rest[0]):
        names = rest[0].split("|")
        assert set(names) <= set(command.commands), f"embomatrix {' '.join(words)}"
        command, rest = command.commands[names[0]], rest[1:]
    return command, rest


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_on_the_page_exists_with_its_options(page: Path) -> None:
    for words in shown(page.read_text(encoding="utf-8")):
        if WORDS & set(words[:2]):
            continue
        command, rest = target_of(words)
        known = {option for each in command.params for option in (*each.opts, *each.secondary_opts)}
        given = {word.split("=")[0] for word in rest if re.match(r"--\w", word)}
        assert given - WORDS <= known, f"embomatrix {' '.join(words)}"


def test_pages_show_commands() -> None:
    assert sum(len(shown(page.read_text(encoding="utf-8"))) for page in PAGES) > 40


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_no_extra_stands_in_a_pattern_of_files(page: Path) -> None:
    # A shell takes [worker] behind a star for one of these letters, finds no such file, and hands the pattern to pip.
    assert not re.findall(r"pip install [^\n`\"']*\*\S*\[\w[^\n`]*", page.read_text(encoding="utf-8"))
