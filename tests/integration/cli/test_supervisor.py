"""Supervisor: restarts, shutdown, and children that are given up."""

import os
import signal
import sys
import time
from collections.abc import Callable

from embomatrix.cli.supervisor import ChildSpec, Supervisor

SLEEPER = (sys.executable, "-c", "import time; print('up', flush=True); time.sleep(60)")
STUBBORN = (
    sys.executable,
    "-c",
    "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(60)",
)


def _child(name: str, arguments: tuple[str, ...]) -> ChildSpec:
    return ChildSpec(name, arguments, dict(os.environ))


def _until(condition: Callable[[], bool], limit_s: float = 15.0) -> None:
    deadline = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < deadline, "waited too long"
        time.sleep(0.05)


def _alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_killed_child_is_restarted(tmp_path):
    with Supervisor((_child("one", SLEEPER), _child("two", SLEEPER)), tmp_path) as children:
        first, other = children.pid("one"), children.pid("two")
        os.kill(first, signal.SIGKILL)
        _until(lambda: children.restarts("one") == 1)
        assert children.pid("one") != first
        assert children.pid("two") == other


def test_children_end_with_the_supervisor(tmp_path):
    with Supervisor((_child("one", SLEEPER), _child("two", SLEEPER)), tmp_path) as children:
        pids = [children.pid("one"), children.pid("two")]
    assert not any(_alive(pid) for pid in pids)


def test_child_that_ignores_sigterm_is_killed(tmp_path):
    with Supervisor((_child("one", STUBBORN),), tmp_path, grace_s=0.5) as children:
        pid = children.pid("one")
        _until(lambda: b"up" in children.log_path("one").read_bytes())
    assert not _alive(pid)


def test_child_that_keeps_dying_is_given_up_and_its_log_kept(tmp_path):
    broken = (sys.executable, "-c", "raise SystemExit('no such scene')")
    with Supervisor((_child("broken", broken),), tmp_path) as children:
        _until(lambda: children.failed() == ("broken",), limit_s=30.0)
        assert children.restarts("broken") > 1
        assert children.last_words("broken") == "no such scene"


def test_child_with_a_user_error_is_given_up_at_once(tmp_path):
    failing = (sys.executable, "-c", "print('no engine: install it', flush=True); raise SystemExit(2)")
    with Supervisor((_child("failing", failing), _child("one", SLEEPER)), tmp_path) as children:
        _until(lambda: children.failed() == ("failing",))
        assert children.restarts("failing") == 0
        assert children.last_words("failing") == "no engine: install it"


def test_interrupt_of_the_terminal_does_not_reach_the_children(tmp_path):
    with Supervisor((_child("one", SLEEPER),), tmp_path) as children:
        assert os.getpgid(children.pid("one")) != os.getpgid(0)


def test_output_of_all_restarts_is_kept_in_one_log(tmp_path):
    with Supervisor((_child("one", SLEEPER),), tmp_path) as children:
        _until(lambda: children.log_path("one").read_bytes().count(b"up") == 1)
        os.kill(children.pid("one"), signal.SIGKILL)
        _until(lambda: children.log_path("one").read_bytes().count(b"up") == 2)
