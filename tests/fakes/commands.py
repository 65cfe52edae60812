"""The real `embomatrix` command as a person runs it: to its end, or in the background until it is stopped."""

import contextlib
import os
import signal
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

from embomatrix.cli.supervisor import embomatrix_command

LIMIT_S = 120.0
HIDING = """
import importlib.machinery, os, sys

HIDDEN = set(os.environ["HIDDEN_PACKAGES"].split(","))


class Finder(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name in HIDDEN else super().find_spec(name, path, target)


sys.meta_path[:] = [Finder if finder is importlib.machinery.PathFinder else finder for finder in sys.meta_path]
"""


@dataclass(frozen=True)
class Told:
    """What a person sees of a command that ended: its exit status and its words, however they were wrapped."""

    status: int
    text: str


def environment(**changes):
    """Of this process, without what would change where a command looks or how much it shows."""
    plain = {
        name: value for name, value in os.environ.items() if not name.startswith(("EMBOMATRIX_", "GRPC_"))
    }
    return {**plain, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", **changes}


def run(*arguments, text="", before=None, **changes):
    """Run the command to its end. ``before`` runs in the child first, ``changes`` are of its environment."""
    result = subprocess.run(
        embomatrix_command(*map(str, arguments)),
        input=text.encode() if isinstance(text, str) else text,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=environment(**changes),
        timeout=LIMIT_S,
        check=False,
        preexec_fn=before,
    )
    return Told(result.returncode, " ".join(result.stdout.decode(errors="replace").split()))


def without(folder, *packages):
    """What hides packages from a command, as if they had never been installed: changes of its environment."""
    (folder / "sitecustomize.py").write_text(HIDING)
    return {"PYTHONPATH": str(folder), "HIDDEN_PACKAGES": ",".join(packages)}


class Background:
    """A command that goes on; what it says is kept in a file."""

    def __init__(self, log, arguments, **changes):
        self._log = Path(log)
        with self._log.open("wb") as file:
            self.process = subprocess.Popen(
                embomatrix_command(*map(str, arguments)),
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                env=environment(**changes),
                start_new_session=True,
            )

    @property
    def text(self):
        return " ".join(self._log.read_text(errors="replace").split())

    def wait_for(self, condition, limit_s=LIMIT_S):
        """Wait until the condition holds, of the command's words where it is a string."""
        deadline = time.monotonic() + limit_s
        while not (condition in self.text if isinstance(condition, str) else condition()):
            assert self.process.poll() is None, self.text
            assert time.monotonic() < deadline, f"waited too long: {self.text}"
            time.sleep(0.05)

    def interrupt(self):
        """Ctrl-C in a terminal: the whole process group hears it."""
        os.killpg(self.process.pid, signal.SIGINT)
        return self.end()

    def end(self):
        return Told(self.process.wait(timeout=LIMIT_S), self.text)


@contextlib.contextmanager
def background(log, *arguments, **changes):
    """A command in the background, ended with the block."""
    command = Background(log, arguments, **changes)
    try:
        yield command
    finally:
        if command.process.poll() is None:
            command.process.terminate()
            try:
                command.process.wait(timeout=15)
            except subprocess.TimeoutExpired:
                command.process.kill()
                command.process.wait()
