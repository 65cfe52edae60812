"""Guard of the unit tests: they start no process, so that all of them run within a minute."""

import sys

import pytest

_EVENTS = frozenset({"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn", "os.spawn"})
_running: list[str] = []


def _refuse_processes(event: str, args: tuple) -> None:
    if _running and event in _EVENTS:
        raise RuntimeError(f"{_running[-1]} starts a process: move it to tests/integration")


sys.addaudithook(_refuse_processes)


@pytest.fixture(autouse=True)
def no_process(request):
    """Make the audit hook refuse new processes while a unit test runs."""
    _running.append(request.node.nodeid)
    yield
    _running.pop()
