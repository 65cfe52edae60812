"""Task files: a task of one's own in about ten lines of TOML, read as a BDDL problem with an instruction."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Final

from msgspec import Meta

from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.factory.task_import.expressible import AGENT, FLOORS
from embomatrix.factory.task_import.sources import ProblemSourceError, SourceText, read_file
from embomatrix.factory.toml_files import TomlFileError, check_keys, read_toml, record_of, wrong, wrong_room
from embomatrix.world.bddl import (
    ROOM_TYPES,
    BddlError,
    BddlProblem,
    InitLiteral,
    is_room_instance,
    parse_formula,
    render_problem,
)
from embomatrix.world.catalog import Catalog, CatalogError
from embomatrix.world.goal import Atom, Formula
from embomatrix.world.records import Record, SceneInvalidError, Text
from embomatrix.world.state import Relation

SUFFIX: Final = ".toml"
MAX_BYTES: Final = 1024 * 1024
MAX_OBJECTS: Final = 200
SOURCE: Final = "file"
SENSES: Final = ("n.01", "n.02", "n.03", "n.04")
"""Senses of a word that is not a category."""
_ROOT: Final = "task"
_OTHER_SUFFIX: Final = f" (a file that does not end in {SUFFIX} is read as BDDL)"
_OBJECT: Final = re.compile(r"([a-z][a-z0-9_]*?)_([0-9]{1,3})\Z")
_AT: Final = re.compile(r"line \d+, column (\d+): ")


@dataclass(frozen=True, slots=True)
class TaskFile:
    """Problem of a person's file. ``scene`` is the base scene or scene file that it names, or empty.

    ``categories`` holds the category of each object whose name is one.
    """

    source: SourceText
    problem: BddlProblem
    scene: str = ""
    categories: Mapping[str, str] = field(default_factory=dict)


class TaskFileTable(Record):
    instruction: Annotated[str, Meta(min_length=1, max_length=2_000)]
    goal: Text
    objects: dict[str, Text | tuple[Text, ...]]
    scene: Text = ""


def read_task_file(path: Path) -> TaskFile:
    """Read a task in TOML, or a BDDL problem from a file of any other suffix.

    Raises ProblemSourceError that names file and key, for BDDL file, line and column.
    """
    if path.suffix != SUFFIX:
        try:
            source = read_file(path)
            return TaskFile(source, read_problem(source)[0])
        except ProblemSourceError as error:
            raise ProblemSourceError(f"{error}{_OTHER_SUFFIX}") from error
        except BddlError as error:
            raise ProblemSourceError(f"{path}: {error}{_OTHER_SUFFIX}") from error
    try:
        value = read_toml(path, at_most=MAX_BYTES, expected="a task")
        check_keys("", value, TaskFileTable, needed=("instruction", "goal", "objects"))
        return _task(path, record_of(value, TaskFileTable, _ROOT))
    except TomlFileError as error:
        raise ProblemSourceError(str(error)) from error
    except SceneInvalidError as error:
        raise ProblemSourceError(f"{path}: {str(error).removeprefix(f'{_ROOT}.')}") from error


def _task(path: Path, table: TaskFileTable) -> TaskFile:
    instruction = " ".join(table.instruction.split())
    if not instruction or not instruction.isprintable():
        raise wrong("instruction", repr(table.instruction[:60]), "a request in printable words")
    if not 1 <= len(table.objects) <= MAX_OBJECTS:
        raise wrong("objects", f"{len(table.objects)} objects", f"1 to {MAX_OBJECTS} lines NAME = FACTS")
    kinds = {name: _kind(name) for name in table.objects}
    types = {name: synset for name, (synset, _) in kinds.items()}
    init = tuple(
        _fact(name, text, types)
        for name, facts in table.objects.items()
        for text in ((facts,) if isinstance(facts, str) else facts)
    )
    try:
        goal = parse_formula(table.goal, types)
    except BddlError as error:
        raise SceneInvalidError("goal", str(error).replace(":objects", "[objects]")) from error
    problem = BddlProblem(re.sub(r"\W+", "_", path.stem, flags=re.ASCII) or "task", types, init, goal)
    source = SourceText(path.stem, render_problem(problem), SOURCE, instruction=instruction)
    try:
        read_problem(source)
    except BddlError as error:  # what only the whole problem shows, such as a goal of too many atoms
        raise SceneInvalidError("goal", _AT.sub("", str(error))) from error
    scene = str(path.parent / table.scene) if table.scene.endswith(".json") else table.scene
    return TaskFile(source, problem, scene, {name: kind for name, (_, kind) in kinds.items() if kind})


def _kind(name: str) -> tuple[str, str]:
    """Return synset and category of an object's name, ``coffee_table_1``; the category is empty for a general word."""
    key = f"objects.{name[:60]}"
    match = _OBJECT.match(name)
    if match is None:
        raise wrong(key, repr(name[:60]), "a category and a number, such as apple_1 or coffee_table_2")
    catalog, word = Catalog.load(), match[1]
    if f"{word}.n.01" == AGENT:
        raise wrong(key, repr(name), "things only: a goal is never about the robot, which has its own place")
    try:
        synset = catalog.synset_of(word)
    except CatalogError as error:
        found = _synset_of(catalog, word)
        if not found:
            raise SceneInvalidError(key, str(error)) from error
        return found, ""
    return synset, "" if synset in FLOORS else word


def _synset_of(catalog: Catalog, word: str) -> str:
    """Return the sense of a general word with the most models, ``table.n.02`` for *table*; empty if none has any."""

    def models(synset: str) -> int:
        known = catalog.has_synset(synset)
        return sum(len(catalog.models_of(name)) for name in catalog.categories_of(synset)) if known else 0

    synsets = [f"{word}.{sense}" for sense in SENSES]
    floor = next((synset for synset in synsets if synset in FLOORS), "")
    best = max(synsets, key=models)
    return floor or (best if models(best) else "")


def _fact(name: str, text: str, types: Mapping[str, str]) -> InitLiteral:
    """Return a fact about an object at the start: ``inroom kitchen``, ``ontop table_1``, ``open`` or ``not open``."""
    key, words = f"objects.{name}", text.split()
    positive = words[:1] != ["not"]
    words = words if positive else words[1:]
    example = "facts such as 'inroom kitchen', 'ontop table_1', 'open' or 'not open'"
    if not words:
        raise wrong(key, repr(text[:60]), example)
    try:
        fact: Formula = parse_formula(f"({words[0]} {name} {' '.join(words[1:])})", types)
    except BddlError as error:
        reason = _AT.sub("", str(error)).replace(":objects", "[objects]").partition(": expected one of")[0]
        raise SceneInvalidError(key, f"found {text[:60]!r}: {reason}; expected {example}") from error
    if not isinstance(fact, Atom):
        raise wrong(key, repr(text[:60]), example)
    if fact.predicate == Relation.INROOM and not _is_room(fact.args[-1]):
        expected = "a room type such as kitchen, or a room such as kitchen_0"
        raise wrong_room(key, fact.args[-1], repr(text[:60]), expected)
    return InitLiteral(fact, positive)


def _is_room(word: str) -> bool:
    return word in ROOM_TYPES or is_room_instance(word)
