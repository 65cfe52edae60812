"""What models answered, kept: a file whose first line says what was asked of whom, and a line for each answer.

Lines are appended as answers come, so that an interrupted evaluation loses none and goes on where it was.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import asdict, dataclass, fields
from typing import TYPE_CHECKING, Any, Final, Self

from embomatrix.skills.prompt import Codec
from embomatrix.trainer.config.errors import TrainerError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path
    from typing import IO

VERSION: Final = 1
"""Of the file's format and of what a verdict depends on. Answers of another version can't be judged by this one."""
FILE: Final = "answers.jsonl"
MOST_SAMPLES: Final = 1000
"""Of a task."""
CODECS: Final = frozenset({*(codec.value for codec in Codec), "eai"})
"""Our own, and EAI's."""


@dataclass(frozen=True, slots=True)
class EvaluationSetup:
    """What was asked, and of whom. Equal setups ask equal questions.

    ``bench_digest`` names the tasks; ``questions`` is a hash of all prompts, empty where a baseline was not asked in words.
    ``rows`` are the rows of the object table that a prompt tells at most; ``seed`` also seeds the execution.
    """

    bench: str
    bench_digest: str
    split: str
    tasks: int
    model: str
    codec: str
    rows: int
    samples: int
    temperature: float
    max_tokens: int
    seed: int
    questions: str = ""
    by_rule: int = 0
    profile: str = "household"


@dataclass(frozen=True, slots=True)
class Answer:
    """One sample of one task. ``finish`` is "length" where the text was cut off; tokens are 0 where nobody counted."""

    task_id: str
    sample: int
    text: str
    finish: str = ""
    prompt_tokens: int = 0
    completion_tokens: int = 0


class AnswerSheet:
    """Context manager over the file: what is there already, and where more goes."""

    def __init__(self, path: Path, setup: EvaluationSetup) -> None:
        """Raises TrainerError when the file holds answers to other questions, or can't be read or written."""
        self.path = path
        self.setup = setup
        self._answers: dict[tuple[str, int], Answer] = {}
        self._file: IO[bytes] | None = None

    def __enter__(self) -> Self:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            begun = self.path.exists() and b"\n" in self.path.read_bytes()
            if begun:
                self._take_up()
            self._file = self.path.open("ab" if begun else "wb")
            if not begun:
                self._write({"answers": VERSION, **asdict(self.setup)})
        except OSError as error:
            raise TrainerError(
                f"the answers {self.path} can't be written ({error.strerror}): pass another --out"
            ) from error
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def __len__(self) -> int:
        return len(self._answers)

    def __contains__(self, key: tuple[str, int]) -> bool:
        return key in self._answers

    def add(self, answers: Iterable[Answer]) -> None:
        """Keep answers; those that are there already stay as they are."""
        for answer in answers:
            key = (answer.task_id, answer.sample)
            if key not in self._answers:
                self._answers[key] = answer
                self._write(asdict(answer))

    def ordered(self, task_ids: Iterable[str]) -> tuple[Answer, ...]:
        """Answers task by task, sample by sample: the order in which they came leaves no trace."""
        return ordered(self._answers, task_ids, self.setup.samples)

    def _take_up(self) -> None:
        setup, answers, whole = _read(self.path)
        differing = [
            f"{entry.name} {getattr(setup, entry.name)!r}, now {getattr(self.setup, entry.name)!r}"
            for entry in fields(EvaluationSetup)
            if getattr(setup, entry.name) != getattr(self.setup, entry.name)
        ]
        if differing:
            raise TrainerError(
                f"{self.path} holds answers to other questions ({'; '.join(differing)}): pass the same again, or another --out"
            )
        # A line that was cut short by a kill or a full disk is asked for again.
        os.truncate(self.path, whole)
        self._answers = {(answer.task_id, answer.sample): answer for answer in answers}

    def _write(self, value: Mapping[str, Any]) -> None:
        assert self._file is not None
        try:
            self._file.write(json.dumps(value).encode("ascii") + b"\n")
            self._file.flush()
        except OSError as error:
            raise TrainerError(
                f"the answers {self.path} can't be written ({error.strerror}): make room; what came before is kept, and the "
                "same command goes on from there"
            ) from error


def read_answers(path: Path) -> tuple[EvaluationSetup, dict[tuple[str, int], Answer]]:
    """What a file holds. Raises TrainerError when it can't be read or is of another version."""
    try:
        setup, answers, _ = _read(path)
    except OSError as error:
        raise TrainerError(
            f"the answers {path} can't be read ({error.strerror}): expected the {FILE} of an evaluation"
        ) from error
    return setup, {(answer.task_id, answer.sample): answer for answer in answers}


def ordered(
    answers: Mapping[tuple[str, int], Answer], task_ids: Iterable[str], samples: int
) -> tuple[Answer, ...]:
    """Answers of these tasks, task by task, sample by sample; what is missing is left out."""
    keys = ((task_id, sample) for task_id in task_ids for sample in range(samples))
    return tuple(answers[key] for key in keys if key in answers)


def check_asked_for(
    stored: Iterable[tuple[str, int]], task_ids: Iterable[str], setup: EvaluationSetup, path: Path
) -> None:
    """Raises TrainerError where a (task, sample) that was answered was never asked for."""
    known = set(task_ids)
    for task_id, sample in stored:
        if task_id not in known or not 0 <= sample < setup.samples:
            raise TrainerError(
                f"{path} holds an answer to sample {sample} of the task {task_id[:80]!r}, which was never asked for: remove "
                "its line"
            )


def _read(path: Path) -> tuple[EvaluationSetup, list[Answer], int]:
    """The setup, the answers, and the length in bytes of the lines that are whole."""
    data = path.read_bytes()
    whole = data.rfind(b"\n") + 1
    lines = data[:whole].splitlines()
    if not lines:
        raise TrainerError(f"{path} holds no answers: expected the {FILE} of an evaluation")
    header = _line(lines[0], path, 1)
    if "answers" not in header:
        raise TrainerError(
            f"{path} is no file of answers (its first line names no version): expected the {FILE} of an evaluation"
        )
    version = header.pop("answers")
    if version != VERSION:
        raise TrainerError(
            f"{path} is of another version (found {version!r}, expected {VERSION}): ask the model again, or judge it with the "
            "version of embomatrix that wrote it"
        )
    setup = _made(EvaluationSetup, header, path, 1)
    _check(setup, path)
    answers = [
        _made(Answer, _line(line, path, number), path, number) for number, line in enumerate(lines[1:], 2)
    ]
    return setup, answers, whole


def _check(setup: EvaluationSetup, path: Path) -> None:
    """What were options of the command is what it takes. Raises TrainerError."""
    for name, sound, expected in (
        ("samples", 1 <= setup.samples <= MOST_SAMPLES, f"1 to {MOST_SAMPLES}"),
        ("tasks", setup.tasks >= 1, "1 or more"),
        ("rows", setup.rows >= 1, "1 or more"),
        ("max_tokens", setup.max_tokens >= 1, "1 or more"),
        ("seed", setup.seed >= 0, "0 or more"),
        ("by_rule", setup.by_rule >= 0, "0 or more"),
        ("temperature", 0 <= setup.temperature < math.inf, "0 or more"),
        ("codec", setup.codec in CODECS, ", ".join(sorted(CODECS))),
    ):
        if not sound:
            raise TrainerError(
                f"{path}, line 1, is damaged: found {name} {getattr(setup, name)!r}, expected {expected}; ask the model again"
            )


def _line(line: bytes, path: Path, number: int) -> dict[str, Any]:
    try:
        value = json.loads(line)
    except (ValueError, RecursionError) as error:
        raise TrainerError(f"{path}, line {number}, is damaged ({error}): remove the line") from error
    if not isinstance(value, dict):
        raise TrainerError(f"{path}, line {number}, is damaged (expected an object): remove the line")
    return value


def _made(kind: type[Any], value: Mapping[str, Any], path: Path, number: int) -> Any:
    """A record of the file. Fields must be there, known and of their types."""
    types = {entry.name: str(entry.type) for entry in fields(kind)}
    plain: Mapping[str, tuple[type, ...]] = {"str": (str,), "int": (int,), "float": (int, float)}
    wrong = sorted(
        name
        for name in value.keys() | types.keys()
        if not _fits(value, name, plain.get(types.get(name, ""), ()))
    )
    if wrong:
        raise TrainerError(
            f"{path}, line {number}, is damaged: {wrong[0]!r} is missing, unknown or of a wrong type; remove the line"
        )
    return kind(**value)


def _fits(value: Mapping[str, Any], name: str, types: tuple[type, ...]) -> bool:
    return name in value and isinstance(value[name], types) and not isinstance(value[name], bool)
