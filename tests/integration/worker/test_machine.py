"""Observation of a machine from real files, real processes and output of loginctl."""

import os
import subprocess
import sys
import time

import pytest

from embomatrix.worker.host.machine import (
    NEVER_S,
    CpuTimes,
    HostMachine,
    HostMeter,
    Owner,
    desktop_active_s,
    family_cpu_s,
    terminal_active_s,
)
from embomatrix.worker.host.owner_policy import Observation, Preferences
from embomatrix.worker.host.resources import free_disk_mb

BUSY = "import time\nend = time.process_time() + 0.4\nwhile time.process_time() < end: pass\n"


def test_typing_in_any_terminal_is_user_activity(tmp_path):
    for name, typed_s in (
        ("pts/0", 1000),
        ("pts/7", 3000),
        ("tty1", 2000),
        ("pts/ptmx", 9000),
        ("tty", 9000),
    ):
        path = tmp_path / name
        path.parent.mkdir(exist_ok=True)
        path.touch()
        os.utime(path, (typed_s, 9000))
    assert terminal_active_s(tmp_path) == 3000


def test_machine_without_terminals_and_desktops_is_idle(tmp_path):
    assert Owner(tmp_path, sessions=str).idle_s(time.time()) == NEVER_S


DESKTOP = "Type=wayland\nClass=user\nState=active\nIdleHint={}\nIdleSinceHint={}\n"
TERMINAL = "Type=tty\nClass=user\nState=active\nIdleHint=no\nIdleSinceHint=0\n"
GREETER = "Type=x11\nClass=greeter\nState=active\nIdleHint=no\nIdleSinceHint=0\n"
CLOSING = "Type=x11\nClass=user\nState=closing\nIdleHint=no\nIdleSinceHint=0\n"


@pytest.mark.parametrize(
    ("sessions", "active_s"),
    [
        ("", None),
        (DESKTOP.format("no", 0), 5000.0),
        (DESKTOP.format("yes", 4_000_000_000), 4000.0),
        (DESKTOP.format("yes", "n/a"), 5000.0),
        (DESKTOP.format("yes", 4_000_000_000) + "\n" + DESKTOP.format("yes", 4_500_000_000), 4500.0),
        (f"{TERMINAL}\n{GREETER}\n{CLOSING}", None),
        (TERMINAL + "\n" + DESKTOP.format("no", 0), 5000.0),
    ],
)
def test_desktop_is_in_use_until_its_idle_hint(sessions, active_s):
    assert desktop_active_s(sessions, 5000.0) == active_s


def test_load_of_others_is_busy_time_without_our_processes():
    before = CpuTimes(total_s=100, busy_s=50, ours_s=40)
    assert CpuTimes(200, 90, 60).others_share_since(before) == pytest.approx(0.2)
    assert CpuTimes(200, 90, 10).others_share_since(before) == pytest.approx(0.4)
    assert before.others_share_since(before) == 0.0


def test_descendants_count_as_ours_even_after_their_end():
    before_s = family_cpu_s(os.getpid())
    subprocess.run([sys.executable, "-c", BUSY], check=True)
    # The kernel counts whole ticks of 0.01 s here and may drop one at each end.
    assert family_cpu_s(os.getpid()) - before_s >= 0.38


def test_ended_process_has_no_cpu_time():
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    assert family_cpu_s(process.pid) == 0.0


def test_only_other_programs_are_load_of_others():
    ours, without_processes = HostMachine(lambda: [os.getpid()]), HostMachine(list)
    subprocess.run([sys.executable, "-c", BUSY], check=True)
    # Both observed all other load of this machine; their difference is our load.
    share, whole = ours.observe().others_load, without_processes.observe().others_load
    assert whole > share


def test_this_machine_can_be_observed():
    seen = HostMachine(lambda: [os.getpid()]).observe()
    assert 0 <= seen.minute < 24 * 60
    assert 0 <= seen.others_load <= 1
    assert 0 < seen.free_memory < 1
    assert seen.owner_idle_s >= 0


def test_unsupported_preference_is_reported():
    machine = HostMachine(list)
    preferences = Preferences(idle_s=60, mains_only=True)
    assert len(machine.unsupported(preferences, Observation(0))) == 2
    assert machine.unsupported(preferences, Observation(0, owner_idle_s=5.0, on_mains=True)) == []
    assert machine.unsupported(Preferences(), Observation(0)) == []


def test_free_space_is_measured_at_the_nearest_existing_folder(tmp_path):
    assert free_disk_mb(tmp_path / "not" / "yet") == pytest.approx(free_disk_mb(tmp_path), rel=0.5)
    assert free_disk_mb(tmp_path) > 0


def test_use_of_the_machine_is_between_nothing_and_everything():
    meter = HostMeter()
    end_s = time.monotonic() + 0.3
    while time.monotonic() < end_s:
        pass
    use = meter.use()
    assert 0.0 < use.cpu_share <= 1.0
    assert 0 < use.memory_used_mb <= use.memory_mb
