"""Cassette: recorded answers of a model, so that a run can be repeated without the model."""

import hashlib
import json
import os
from collections import Counter
from pathlib import Path
from typing import Any

from embomatrix.llm.ledger import append_line
from embomatrix.llm.values import CassetteError, ChatModel, ChatRequest, Reply, Usage
from embomatrix.world.json_text import parse_json


class Cassette:
    """Model behind a recording: a file of JSON lines, one answer each.

    Repeated equal questions are counted, and the n-th gets the n-th answer. ``model`` is asked unrecorded questions. Without
    it, CassetteError is raised for a missing file and for an unrecorded question; in any case for a damaged file.
    """

    def __init__(self, path: Path, model: ChatModel | None = None) -> None:
        if model is None and not path.exists():
            raise CassetteError(f"there is no cassette at {path}: record one first")
        self._path = path
        self._model = model
        self._asked: Counter[str] = Counter()
        self._answers = _read(path) if path.exists() else {}
        if model is not None and path.exists():
            _drop_cut_line(path)

    async def complete(self, request: ChatRequest) -> Reply:
        """Return the recorded answer, or ask the model and record its answer."""
        question = digest(request)
        number = self._asked[question]
        self._asked[question] += 1
        found = self._answers.get((question, number))
        if found is not None:
            return found
        if self._model is None:
            raise CassetteError(
                f"{request.purpose}: the cassette {self._path} has no answer {number + 1} to question {question[:12]}: the "
                "question has changed since the recording; record it again"
            )
        reply = await self._model.complete(request)
        self._write(question, number, request.purpose, reply)
        return reply

    def _write(self, question: str, number: int, purpose: str, reply: Reply) -> None:
        line = {
            "question": question,
            "number": number,
            "purpose": purpose,
            "text": reply.text,
            "model": reply.model,
            "prompt_tokens": reply.usage.prompt_tokens,
            "completion_tokens": reply.usage.completion_tokens,
            "finish": reply.finish,
        }
        append_line(self._path, line)


def digest(request: ChatRequest) -> str:
    """Return the SHA-256, in hex, of a question without its purpose and the model's name."""
    content: dict[str, Any] = {
        "messages": [
            [
                message.speaker.value,
                message.text,
                [hashlib.sha256(image).hexdigest() for image in message.images],
            ]
            for message in request.messages
        ],
        "max_tokens": request.max_tokens,
        "temperature": request.temperature,
        "seed": request.seed,
        "schema": request.json_schema,
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _drop_cut_line(path: Path) -> None:
    """Drop a last line that a kill or a full disk has cut off: its question is asked again."""
    data = path.read_bytes()
    complete = data.rfind(b"\n") + 1
    if complete < len(data):
        os.truncate(path, complete)


def _read(path: Path) -> dict[tuple[str, int], Reply]:
    answers = {}
    data = path.read_bytes()
    for number, line in enumerate(data[: data.rfind(b"\n") + 1].splitlines(), start=1):
        try:
            value = parse_json(line)
            usage = Usage(int(value["prompt_tokens"]), int(value["completion_tokens"]))
            reply = Reply(str(value["text"]), str(value["model"]), usage, str(value["finish"]), seconds=0.0)
            answers[str(value["question"]), int(value["number"])] = reply
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            raise CassetteError(
                f"{path}, line {number}, is not a recorded answer ({error}): remove the line"
            ) from error
    return answers
