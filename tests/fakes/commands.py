"""The real `embomatrix` command as a person runs it: to its end, or in the background until it is stopped."""

import contextlib
import functools
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from tests.fakes.command_server import STATUS, ask

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


def run(*arguments, text="", **changes):
    """Run the command to its end; ``changes`` are of its environment. What it imports was imported before."""
    with tempfile.TemporaryFile() as said, tempfile.TemporaryFile() as given:
        given.write(_bytes(text))
        given.seek(0)
        streams = (given.fileno(), said.fileno(), said.fileno())
        ended = ask(_server(), map(str, arguments), environment(**changes), streams)
        with contextlib.closing(ended):
            if not select.select([ended], [], [], LIMIT_S)[0]:
                raise TimeoutError(f"embomatrix {' '.join(map(str, arguments))}: no end after {LIMIT_S:g} s")
            (status,) = STATUS.unpack(ended.read(STATUS.size))
        said.seek(0)
        return Told(status, _words(said.read()))


def run_anew(*arguments, text="", before=None, **changes):
    """The same in a process that starts from nothing. ``before`` runs in it first."""
    result = subprocess.run(
        embomatrix_command(*map(str, arguments)),
        input=_bytes(text),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=environment(**changes),
        timeout=LIMIT_S,
        check=False,
        preexec_fn=before,
    )
    return Told(result.returncode, _words(result.stdout))


def _bytes(text):
    return text.encode() if isinstance(text, str) else text


def _words(said):
    return " ".join(said.decode(errors="replace").split())


@functools.cache
def _server():
    """Started with the first command of this process, and ended by the end of it."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with theirs:
        # The verbosity is read when grpc is imported, and the command sets it only then.
        subprocess.Popen(
            [sys.executable, "-m", "tests.fakes.command_server", str(theirs.fileno())],
            cwd=Path(__file__).parents[2],
            env=environment(GRPC_VERBOSITY="ERROR"),
            pass_fds=[theirs.fileno()],
        )
    return ours


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
                # A shell has what it runs in the background ignore Ctrl-C, and that is inherited.
                preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
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
