"""The real `embomatrix` command, run to its end or in the background."""

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
class CommandResult:
    """Exit status and text of a finished command, with line breaks removed."""

    status: int
    text: str


def environment(**changes):
    """Return this process's environment without variables that change paths or output of a command."""
    plain = {
        name: value for name, value in os.environ.items() if not name.startswith(("EMBOMATRIX_", "GRPC_"))
    }
    return {**plain, "OMP_NUM_THREADS": "1", "PYTHONUNBUFFERED": "1", **changes}


def run(*arguments, text="", **changes):
    """Run the command to its end in a fork of the command server. ``changes`` apply to its environment."""
    with tempfile.TemporaryFile() as output, tempfile.TemporaryFile() as given:
        given.write(_bytes(text))
        given.seek(0)
        streams = (given.fileno(), output.fileno(), output.fileno())
        ended = ask(_server(), map(str, arguments), environment(**changes), streams)
        with contextlib.closing(ended):
            if not select.select([ended], [], [], LIMIT_S)[0]:
                raise TimeoutError(f"embomatrix {' '.join(map(str, arguments))}: no end after {LIMIT_S:g} s")
            (status,) = STATUS.unpack(ended.read(STATUS.size))
        output.seek(0)
        return CommandResult(status, _words(output.read()))


# What a process does before it becomes the command. Not a ``preexec_fn``: that runs in a fork of this process, where gRPC's
# threads are missing, and now and then one crashed.
_BEFORE = "import os, resource, signal, sys; {}; os.execv(sys.executable, [sys.executable, *sys.argv[1:]])"
_HEARS_INTERRUPTS = "signal.signal(signal.SIGINT, signal.SIG_DFL)"
_SMALL_FILES = "resource.setrlimit(resource.RLIMIT_FSIZE, ({0}, {0}))"


def _after(before, arguments):
    _, *rest = embomatrix_command(*map(str, arguments))
    return [sys.executable, "-S", "-c", _BEFORE.format(before), *rest]


def run_anew(*arguments, text="", largest_file=None, **changes):
    """Run the command in a fresh process. No file may exceed ``largest_file`` bytes, like on a full disk."""
    before = "pass" if largest_file is None else _SMALL_FILES.format(largest_file)
    result = subprocess.run(
        _after(before, arguments),
        input=_bytes(text),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env=environment(**changes),
        timeout=LIMIT_S,
        check=False,
    )
    return CommandResult(result.returncode, _words(result.stdout))


def _bytes(text):
    return text.encode() if isinstance(text, str) else text


def _words(output):
    return " ".join(output.decode(errors="replace").split())


@functools.cache
def _server():
    """Start the command server on first use; it ends with this process."""
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
    """Return environment changes that hide packages from a command, as if they were not installed."""
    (folder / "sitecustomize.py").write_text(HIDING)
    return {"PYTHONPATH": str(folder), "HIDDEN_PACKAGES": ",".join(packages)}


class Background:
    """Command that runs in the background; a file keeps its output."""

    def __init__(self, log, arguments, **changes):
        self._log = Path(log)
        with self._log.open("wb") as file:
            self.process = subprocess.Popen(
                # A shell makes its background processes ignore Ctrl-C, and children inherit that.
                _after(_HEARS_INTERRUPTS, arguments),
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
        """Wait until the condition holds; a string is awaited in the command's output."""
        deadline = time.monotonic() + limit_s
        while not (condition in self.text if isinstance(condition, str) else condition()):
            assert self.process.poll() is None, self.text
            assert time.monotonic() < deadline, f"waited too long: {self.text}"
            time.sleep(0.05)

    def interrupt(self):
        """Send SIGINT to the whole process group, like Ctrl-C in a terminal."""
        os.killpg(self.process.pid, signal.SIGINT)
        return self.end()

    def terminate(self):
        """Send SIGTERM to the whole process group, as `timeout` and schedulers do."""
        os.killpg(self.process.pid, signal.SIGTERM)
        return self.end()

    def end(self):
        return CommandResult(self.process.wait(timeout=LIMIT_S), self.text)


@contextlib.contextmanager
def background(log, *arguments, **changes):
    """Run a command in the background and end it with the block."""
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
