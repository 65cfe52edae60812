"""Physics-free simulation for the slot program; the bundle file or the task id scripts its behaviour.

Run as ``python simulation.py FD PARENT``, like the real one.
"""

import os
import random
import signal
import sys
import time
import zlib
from pathlib import Path

from embomatrix.reward.breakdown import AtomResult, RewardBreakdown
from embomatrix.rpc.wire.values import Completed, Timings
from embomatrix.skills.trace import Step
from embomatrix.worker.slots.slot_program import BundleCorruptError, run_program

PROGRAM = (sys.executable, __file__)


class FakeSimulation:
    def prepare(self):
        if os.environ.get("FAKE_SIMULATION") == "broken":
            raise RuntimeError("the engine is missing: install it")

    def load(self, path, digest, *, sharing):
        match _word_in(path):
            case "corrupt":
                raise BundleCorruptError("not what its digest says")
            case "impossible":
                raise ValueError("a table without legs")
            case "crash":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "huge":
                return FakeScene(ballast=bytearray(8 * 1024 * 1024 * 1024))
            case "large":
                return FakeScene(ballast=bytearray(os.urandom(1) * (40 * 1024 * 1024)))
        return FakeScene()


def _meet(folder):
    """Wait until two executions are here at once."""
    (folder / f"{os.getpid()}.here").touch()
    while len(list(folder.glob("*.here"))) < 2:
        time.sleep(0.01)


def _word_in(path):
    """Return the text of the file, decompressed if a real manager sent it."""
    content = path.read_bytes()
    return (zlib.decompress(content) if content.startswith(b"x") else content).decode()


class FakeScene:
    def __init__(self, ballast=b""):
        self._ballast = ballast
        self._executed = 0

    def complete(self):
        yield from (None,) * 3

    def execute(self, rollout, on_step, reward):
        self._executed += 1
        times = note(rollout.rollout_id)
        on_step(1)
        words = ()
        match rollout.task_id:
            case "first slow":
                time.sleep(3.0 if times == 1 else 0.01)
            case "first hangs":
                time.sleep(600 if times == 1 else 0.01)
            case "short":
                time.sleep(0.005)
            case "brief":
                time.sleep(0.05)
            case "crash":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "hang":
                on_step(2)
                time.sleep(600)
            case "slow":
                time.sleep(0.3)
            case str() as task if task.startswith("meet "):
                _meet(Path(task.removeprefix("meet ")))
            case "steps":
                for number in range(2, 40):
                    time.sleep(0.05)
                    on_step(number)
            case "raise":
                raise ArithmeticError("x" * 600)
            case "grow":
                self._ballast = bytearray(b"x") * (150 * 1024 * 1024)
            case "greedy":
                self._ballast = bytearray(4 * 1024 * 1024 * 1024)
            case "long":
                words = ("x" * 3000,) * 20
            case "endless":
                words = ("x" * 3000,) * 40
            case "orphan":
                os.kill(os.getppid(), signal.SIGKILL)
                time.sleep(600)
            case "stop":
                os.kill(os.getppid(), signal.SIGSTOP)
                time.sleep(1.0)
        made_up = lies()
        holds = [number < (0 if made_up else satisfied(rollout)) for number in range(3)]
        atoms = tuple(AtomResult(f"done {number}", truth) for number, truth in enumerate(holds))
        return Completed(
            reward=RewardBreakdown(reward.format, 0.0, reward.goal * sum(holds) / 3, atoms, all(holds)),
            steps=tuple(Step(call, None, "done") for call in rollout.plan),
            final=(f"executed {self._executed} in {os.getpid()} of {os.getppid()}", *words),
            trace_digest=f"{'no ' if made_up else ''}trace of {rollout.rollout_id}",
            worker_id="",
            timings=Timings(),
            warm=True,
        )


def satisfied(rollout):
    """Return the number of the three atoms that hold."""
    return zlib.crc32(rollout.rollout_id.encode()) % 4 if rollout.task_id == "graded" else 3


def lies():
    """Return a fabricated reward for the share of rollouts that the environment names; otherwise 0."""
    return 99.0 if random.SystemRandom().random() < float(os.environ.get("FAKE_LIES", "0")) else 0.0


def graded(rollout_id):
    return float(zlib.crc32(rollout_id.encode()) % 4) * 10.0


def graded_total(rollout_id):
    return 0.5 + graded(rollout_id)


def note(rollout_id):
    """Record the start of an execution and return how often this rollout has started."""
    path = os.environ.get("FAKE_EXECUTIONS")
    if not path:
        return 1
    with open(path, "a+") as file:
        file.write(f"{rollout_id}\n")
        file.flush()
        file.seek(0)
        return file.read().split().count(rollout_id)


if __name__ == "__main__":
    run_program(FakeSimulation())
