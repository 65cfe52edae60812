"""Commands of the start page, typed one after the other in an empty folder."""

import contextlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.fakes.commands import environment

from embomatrix.cli.local_cluster import free_port

PAGE = Path(__file__).parents[2] / "docs" / "index.md"
LIMIT_S = 600.0
SERVES = {"manager serve": "status page", "worker run": "registered with the manager"}
"""Commands that go on, and what they say once they are of use."""
NEED_MORE = ("runs/demo", "--interactive", "factory generate")
"""Words of commands that need `make run`, a person, or minutes."""
SHORT = {"embomatrix train": " --imitate-seconds 1 --steps 1", "worker run": " --slots 1"}
"""Options that the test adds to finish soon."""
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]


def lines_below(heading):
    """Return the lines of the code blocks in a section, without comments."""
    section = PAGE.read_text(encoding="utf-8").split(f"\n## {heading}\n")[1].split("\n## ")[0]
    blocks = re.findall(r"^```\n(.*?)^```", section, re.MULTILINE | re.DOTALL)
    return [line.split("  #")[0].strip() for block in blocks for line in block.splitlines()]


class Shell:
    """Terminals of one user on one machine, with a dedicated folder, home and ports."""

    def __init__(self, folder):
        self.folder = folder
        self.port, self.page_port = free_port(), free_port()
        self._services = contextlib.ExitStack()
        self._assigned = []
        home, tools = folder / "home", folder / "bin"
        home.mkdir()
        tools.mkdir()
        command = tools / "embomatrix"
        command.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} -m embomatrix.cli "$@"\n')
        command.chmod(0o755)
        self._environment = environment(
            HOME=str(home), PATH=f"{tools}:{os.environ['PATH']}", EMBOMATRIX_MANAGER=f"127.0.0.1:{self.port}"
        )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._services.close()

    def type(self, line):
        """Return the line's final output. A command that keeps running ends when the terminals close."""
        line = line.replace("HOST:50070", f"localhost:{self.port}").replace("HOST", "localhost")
        for part, options in SHORT.items():
            line += options if part in line else ""
        if "manager serve" in line:
            line += f" --port {self.port} --http-port {self.page_port}"
        if re.match(r"[A-Z]+=", line):
            self._assigned.append(line)
            return ""
        ready_words = next((words for part, words in SERVES.items() if part in line), None)
        return self._ended(line) if ready_words is None else self._serving(line, ready_words)

    def close_terminals(self):
        """Send Ctrl-C to every command that still serves."""
        self._services.close()

    def _ended(self, line):
        result = self._run(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        said, _ = result.communicate(timeout=LIMIT_S)
        assert result.returncode == 0, f"{line}\n{said.decode()}"
        return said.decode()

    def _serving(self, line, ready_words):
        log = self.folder / f"{time.monotonic_ns()}.log"
        with log.open("wb") as file:
            process = self._run(f"exec {line}", stdout=file, stderr=subprocess.STDOUT)
        self._services.callback(_stop, process)
        ends_s = time.monotonic() + LIMIT_S
        while ready_words not in log.read_text():
            assert process.poll() is None, f"{line}\n{log.read_text()}"
            assert time.monotonic() < ends_s, f"{line}\n{log.read_text()}"
            time.sleep(0.1)
        return log.read_text()

    def _run(self, line, **streams):
        script = "\n".join([*self._assigned, line])
        return subprocess.Popen(
            ["bash", "-c", script],
            cwd=self.folder,
            env=self._environment,
            stdin=subprocess.DEVNULL,
            **streams,
        )


def _stop(process):
    process.terminate()
    process.wait(timeout=60)


def test_every_quick_command_of_the_start_page_works(tmp_path):
    shutil.copytree(PAGE.parent / "examples", tmp_path / "docs" / "examples")
    with Shell(tmp_path) as shell:
        commands = [line for line in lines_below("A plan in a scene") if line.startswith("embomatrix")]
        task = ""
        for line in commands:
            if any(words in line for words in NEED_MORE):
                continue
            said = shell.type(line.replace("TASK", task))
            if line.endswith("factory list"):
                task = re.search(r"[\w-]+-(?:train|heldout)-[\d-]+", said)[0]
            assert "--oracle" not in line or "success" in said
        assert any("--oracle" in line for line in commands)
        assert task in (tmp_path / f"{task}.html").read_text()

        *trained, closed, report, doctor = lines_below("A cluster of your own")
        for line in trained:
            shell.type(line)
        run = re.search(r"run-\w+", shell.type(closed))[0]
        shell.type(report.replace("RUN", run))
        assert "first" in (tmp_path / "report.html").read_text()
        assert "0 of" not in shell.type(doctor)
        shell.close_terminals()

        *opened, joining, status = lines_below("A second PC")
        invitation = [shell.type(line) for line in opened][-1].splitlines()[0]
        # The other PC knows nothing of this cluster but the string.
        join = joining.replace("TOKEN@HOST:50070", invitation)
        assert "joined the manager" in shell.type(f"env -u EMBOMATRIX_MANAGER {join}")
        assert "waiting for work" in shell.type(status)
