"""EAI's judge in a separate process, so a hostile answer can only affect its own verdict."""

import contextlib
import json
import resource
import select
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Self

from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.eai.environment import JudgeEnvironment
from embomatrix.trainer.eai.sanitise import sanitise_answer

ANSWER_S: Final = 60.0
"""Timeout per answer. The longest human plan takes 0.2 s; starting takes a few seconds."""
MEMORY_BYTES: Final = 4 * 1024**3
INSIDE: Final = ("embomatrix", "trainer", "eai", "inside")


@dataclass(frozen=True, slots=True)
class NativeTask:
    """Task as EAI publishes it. ``category`` follows ``inside.categories``; ``human`` is the published plan."""

    demo: str
    task: str
    scene: str
    prompt: str
    human: str
    category: str


@dataclass(frozen=True, slots=True)
class NativeResult:
    """Result of one answer.

    ``official`` is the published success, ``exact`` the truth of the goal's formula; both require a complete execution.
    ``goals`` are the truths of the goal's conjuncts in the final state. ``errors`` are the judge's messages by kind.
    """

    official: bool
    exact: bool
    executed: bool
    goals: tuple[bool, ...]
    errors: Mapping[str, str]


class NativeJudge:
    """Context manager over the judge's process, which is restarted after a crash."""

    def __init__(self, environment: JudgeEnvironment) -> None:
        self._environment = environment
        self._stack = contextlib.ExitStack()
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Self:
        self._folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory(prefix="embomatrix-eai-")))
        # Copied to its own root, because the judge's packages have the names of ours.
        inside = Path(__file__).parent / INSIDE[-1]
        shutil.copytree(inside, self._folder.joinpath(*INSIDE), ignore=shutil.ignore_patterns("__pycache__"))
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()
        self._stack.close()

    def tasks(self) -> tuple[NativeTask, ...]:
        """Return the hundred tasks. Raises TrainerError if the judge can't start."""
        found = self._request({"op": "tasks"})
        if found is None:
            raise TrainerError(
                f"EAI's judge in {self._environment.folder} does not start: remove the folder and run `embomatrix eai install`"
            )
        return tuple(NativeTask(**task) for task in found["tasks"])

    def judge(self, demo: str, text: str) -> NativeResult | None:
        """Return the result of an answer after sanitising it. None if the judge crashed or timed out."""
        found = self._request({"op": "judge", "id": demo, "demo": demo, "text": sanitise_answer(text)})
        if found is None:
            return None
        goals = tuple(found["goals"])
        return NativeResult(found["official"], found["exact"], found["executed"], goals, found["errors"])

    def first_truths(self, demo: str) -> tuple[tuple[bool, ...], tuple[bool, ...]]:
        """Truths of the published goals in the initial state: in the reconstruction, and in the real simulator."""
        found = self._request({"op": "start", "demo": demo})
        if found is None:
            raise TrainerError(
                f"EAI's judge can't set up the task {demo}: reinstall it with `embomatrix eai install`"
            )
        there = tuple(bool(true) for true in found["there"])
        return tuple(at in found["here"] for at in range(len(there))), there

    def _request(self, order: Mapping[str, Any]) -> dict[str, Any] | None:
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
            [str(self._environment.python), "-s", "-m", program],
            cwd=self._folder,
            env={"PYTHONPATH": str(self._folder), "PYTHONDONTWRITEBYTECODE": "1", "PYTHONUTF8": "1"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            preexec_fn=_limit_resources,
        )
        return self._process

    def _stop(self) -> None:
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.communicate()


def _limit_resources() -> None:
    """Runs in the child process before the judge: limit memory, forbid files and core dumps."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
