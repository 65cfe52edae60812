"""EAI's judge in a process of its own: orders go in, results come out, and what a text does to it costs that text alone."""

from __future__ import annotations

import contextlib
import json
import resource
import select
import shutil
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Self

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.eai.sanitise import sanitised

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.trainer.eai.environment import JudgeEnvironment

ANSWER_S: Final = 60.0
"""For one answer; the longest of the human plans takes 0.2 s. Starting takes a few seconds more."""
MEMORY_BYTES: Final = 4 * 1024**3
INSIDE: Final = ("embomatrix", "trainer", "eai", "inside")


@dataclass(frozen=True, slots=True)
class NativeTask:
    """A task as EAI asks it. ``category`` is by the rule of ``inside.categories``; ``human`` is the published plan."""

    demo: str
    task: str
    scene: str
    prompt: str
    human: str
    category: str


@dataclass(frozen=True, slots=True)
class NativeResult:
    """What the judge says of one answer.

    ``official`` is the published success, ``exact`` that of the goal's formula itself; both ask for an execution to the end.
    ``goals`` are the truths of the goal's conjuncts in the state reached. ``errors`` are the judge's own words by kind.
    """

    official: bool
    exact: bool
    executed: bool
    goals: tuple[bool, ...]
    errors: Mapping[str, str]


class NativeJudge:
    """Context manager over the process; started anew where an answer ended it."""

    def __init__(self, environment: JudgeEnvironment, *, published: bool = True) -> None:
        """``published``: use what the package tells of the real simulator's first state."""
        self._environment = environment
        self._arguments = () if published else ("--withhold-published",)
        self._stack = contextlib.ExitStack()
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self._folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="embomatrix-eai-")))
        # Alone, without our other packages beside it: theirs have the same names.
        inside = Path(__file__).parent / INSIDE[-1]
        shutil.copytree(inside, self._folder.joinpath(*INSIDE), ignore=shutil.ignore_patterns("__pycache__"))
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()
        self._stack.close()

    def tasks(self) -> tuple[NativeTask, ...]:
        """The hundred tasks. Raises TrainerError where the judge can't start."""
        found = self._asked({"op": "tasks"})
        if found is None:
            raise TrainerError(
                f"EAI's judge in {self._environment.folder} does not start: remove the folder and run `embomatrix eai install`"
            )
        return tuple(NativeTask(**task) for task in found["tasks"])

    def judge(self, demo: str, text: str) -> NativeResult | None:
        """The verdict on an answer, sanitised first; None where the judge did not survive it or took too long."""
        found = self._asked({"op": "judge", "id": demo, "demo": demo, "text": sanitised(text)})
        if found is None:
            return None
        goals = tuple(found["goals"])
        return NativeResult(found["official"], found["exact"], found["executed"], goals, found["errors"])

    def first_truths(self, demo: str) -> tuple[tuple[bool, ...], tuple[bool, ...]]:
        """Truths of the published goals at the start: in the reconstruction, and in the real simulator."""
        found = self._asked({"op": "start", "demo": demo})
        if found is None:
            raise TrainerError(f"EAI's judge can't set up {demo}")
        there = tuple(bool(true) for true in found["there"])
        return tuple(at in found["here"] for at in range(len(there))), there

    def _asked(self, order: Mapping[str, Any]) -> dict[str, Any] | None:
        process = self._process or self._start()
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            process.stdin.write(json.dumps(order).encode() + b"\n")
            process.stdin.flush()
            line = process.stdout.readline() if select.select([process.stdout], [], [], ANSWER_S)[0] else b""
            value: dict[str, Any] = json.loads(line)
        except (OSError, ValueError):
            self._stop()
            return None
        return value

    def _start(self) -> subprocess.Popen[bytes]:
        program = ".".join((*INSIDE, "program"))
        self._process = subprocess.Popen(
            [str(self._environment.python), "-s", "-m", program, *self._arguments],
            cwd=self._folder,
            env={"PYTHONPATH": str(self._folder), "PYTHONDONTWRITEBYTECODE": "1", "PYTHONUTF8": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=_confine,
        )
        return self._process

    def _stop(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.communicate()


def _confine() -> None:
    """In the child, before it runs: bounded memory, no file of any size, no core."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
