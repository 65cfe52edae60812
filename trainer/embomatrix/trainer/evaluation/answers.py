"""Answer file of an evaluation: a line with the setup, then one JSON line per answer.

Each answer is appended as it arrives, so an interrupted evaluation continues without loss.
"""

import json
import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import IO, Annotated, Any, Final, Self

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from embomatrix.host.failure import unwritable
from embomatrix.skills.prompt import Codec
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.world.json_text import parse_json

VERSION: Final = 1
"""Version of the file format and of everything that a verdict depends on."""
FILE: Final = "answers.jsonl"
HEADER: Final = b'{"answers": '
"""First bytes of each answer file."""
MOST_SAMPLES: Final = 1000
"""Maximum samples per task."""
CODECS: Final = "|".join([*Codec, "eai"])
_STRICT: Final = ConfigDict(extra="forbid", strict=True)
_Count = Annotated[int, Field(ge=1)]
_Natural = Annotated[int, Field(ge=0)]


@dataclass(frozen=True, slots=True, config=_STRICT)
class EvaluationSetup:
    """Questions of an evaluation, and who answers them. Equal setups ask equal questions.

    ``bench_digest`` identifies the tasks. ``questions`` is a hash of all prompts, empty for baselines, which get no prompt.
    ``rows`` is the maximum number of table rows in a prompt. ``seed`` also seeds the execution. ``by_rule`` counts the tasks
    that can't be expressed and count as failed.
    """

    bench: str
    bench_digest: str
    split: str
    tasks: _Count
    model: str
    codec: Annotated[str, Field(pattern=f"^({CODECS})$")]
    rows: _Count
    samples: Annotated[int, Field(ge=1, le=MOST_SAMPLES)]
    temperature: Annotated[float, Field(ge=0, lt=math.inf)]
    max_tokens: _Count
    seed: _Natural
    questions: str = ""
    by_rule: _Natural = 0
    profile: str = "household"
    visibility: Annotated[str, Field(pattern="^(|full|seen)$")] = ""
    """Visibility of episodes; empty for plans. Budget: ``calls_factor`` times the oracle's calls and ``calls_more``."""
    calls_factor: Annotated[float, Field(ge=0, lt=math.inf)] = 0.0
    calls_more: _Natural = 0


@dataclass(frozen=True, slots=True, config=_STRICT)
class Answer:
    """One sample of one task. ``finish`` is "length" for a truncated text. Token counts are 0 if unknown."""

    task_id: str
    sample: int
    text: str
    finish: str = ""
    prompt_tokens: int = 0
    completion_tokens: int = 0


class AnswerSheet:
    """Context manager over an answer file: stored answers, and a place for new ones.

    Entering raises TrainerError if the file answers other questions, or can't be read or written.
    """

    def __init__(self, path: Path, setup: EvaluationSetup) -> None:
        self.path = path
        self.setup = setup
        self._answers: dict[tuple[str, int], Answer] = {}
        self._file: IO[bytes] | None = None

    def __enter__(self) -> Self:
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            before = self.path.read_bytes() if self.path.exists() else b""
            exists = b"\n" in before
            if not exists and not HEADER.startswith(before[: len(HEADER)]):
                raise TrainerError(f"{self.path} is not an answer file: pass another --out, or move it away")
            if exists:
                self._load()
            self._file = self.path.open("ab" if exists else "wb")
            if not exists:
                self._write({"answers": VERSION, **asdict(self.setup)})
        except OSError as error:
            raise TrainerError(f"the answers {unwritable(self.path, error)}") from error
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def __len__(self) -> int:
        return len(self._answers)

    def __contains__(self, key: tuple[str, int]) -> bool:
        return key in self._answers

    def add(self, answers: Iterable[Answer]) -> None:
        """Store new answers. Answers to the same sample of a task are ignored."""
        for answer in answers:
            key = (answer.task_id, answer.sample)
            if key not in self._answers:
                self._answers[key] = answer
                self._write(asdict(answer))

    def ordered(self, task_ids: Iterable[str]) -> tuple[Answer, ...]:
        """Return the answers by task and sample, independent of their order of arrival."""
        return ordered(self._answers, task_ids, self.setup.samples)

    def _load(self) -> None:
        setup, answers, complete_bytes = _read(self.path)
        differing = [
            f"{entry.name} {getattr(setup, entry.name)!r}, now {getattr(self.setup, entry.name)!r}"
            for entry in fields(EvaluationSetup)
            if getattr(setup, entry.name) != getattr(self.setup, entry.name)
        ]
        if differing:
            raise TrainerError(
                f"{self.path} holds answers to other questions ({'; '.join(differing)}): pass the same options again, or "
                "another --out"
            )
        # A kill or a full disk may truncate the last line: drop it, so its question is asked again.
        os.truncate(self.path, complete_bytes)
        self._answers = answers

    def _write(self, value: Mapping[str, Any]) -> None:
        assert self._file is not None
        try:
            self._file.write(json.dumps(value).encode("ascii") + b"\n")
            self._file.flush()
        except OSError as error:
            raise TrainerError(
                f"the answers {self.path} can't be written ({error.strerror}): free disk space; earlier answers are kept, "
                "and the same command continues from there"
            ) from error


def read_answers(path: Path) -> tuple[EvaluationSetup, dict[tuple[str, int], Answer]]:
    """Read an answer file. Raises TrainerError if it is unreadable, damaged or of another version."""
    try:
        setup, answers, _ = _read(path)
    except OSError as error:
        raise TrainerError(
            f"the answers {path} can't be read ({error.strerror}): expected the {FILE} of an evaluation"
        ) from error
    return setup, answers


def ordered(
    answers: Mapping[tuple[str, int], Answer], task_ids: Iterable[str], samples: int
) -> tuple[Answer, ...]:
    """Return the answers of these tasks by task and sample. Missing answers are left out."""
    keys = ((task_id, sample) for task_id in task_ids for sample in range(samples))
    return tuple(answers[key] for key in keys if key in answers)


def check_expected(
    stored: Iterable[tuple[str, int]], task_ids: Iterable[str], setup: EvaluationSetup, path: Path
) -> None:
    """Raise TrainerError if an answer's task or sample is not part of the setup."""
    known = set(task_ids)
    for task_id, sample in stored:
        if task_id not in known or not 0 <= sample < setup.samples:
            raise TrainerError(
                f"{path} holds an answer to sample {sample} of the task {task_id[:80]!r}, which is not part of the evaluation: "
                "remove its line"
            )


def _read(path: Path) -> tuple[EvaluationSetup, dict[tuple[str, int], Answer], int]:
    """Return the setup, the answers, and the length of all complete lines in bytes."""
    data = path.read_bytes()
    complete_bytes = data.rfind(b"\n") + 1
    lines = data[:complete_bytes].splitlines()
    if not lines:
        raise TrainerError(f"{path} contains no answers: expected the {FILE} of an evaluation")
    try:
        header = parse_json(lines[0])
        version = header.pop("answers")
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise TrainerError(
            f"{path} is not an answer file (its first line has no version): expected the {FILE} of an evaluation"
        ) from error
    if version != VERSION:
        raise TrainerError(
            f"{path} has another version (found {version!r}, expected {VERSION}): ask the model again, or judge the answers "
            "with the version of embomatrix that wrote them"
        )
    setup = _validate(EvaluationSetup, json.dumps(header).encode(), path, 1, "ask the model again")
    answers = [
        _validate(Answer, line, path, number, "remove the line") for number, line in enumerate(lines[1:], 2)
    ]
    return setup, {(answer.task_id, answer.sample): answer for answer in answers}, complete_bytes


def _validate(kind: type[Any], line: bytes, path: Path, number: int, remedy: str) -> Any:
    try:
        return TypeAdapter(kind).validate_json(line)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the line"
        raise TrainerError(
            f"{path}, line {number}, is damaged: found {where} {first['input']!r:.80}, expected: {first['msg']}; {remedy}"
        ) from error
