"""Command line of a spare PC: preferences from options and a file, status, and a systemd unit."""

import os
import shutil
import subprocess
import time
from dataclasses import asdict
from pathlib import Path

import pytest
from tests.fakes.systemd import assert_valid_unit, needs_systemd
from typer.testing import CliRunner

from embomatrix.worker.commands.app import app
from embomatrix.worker.commands.install import closed_to_others, quote, unit_text
from embomatrix.worker.commands.run import settings_of
from embomatrix.worker.commands.status import describe, format_duration
from embomatrix.worker.link.membership import Membership
from embomatrix.worker.link.status import StatusFile, WorkerStatus, refuse_second_daemon, running_daemons

DEPLOY = Path(__file__).parents[3] / "deploy"
STATUS = WorkerStatus("w1", os.getpid(), time.time(), slots=4, memory_mb=2000, cache_mb=1024)


def test_options_take_precedence_over_the_file_and_the_file_over_defaults(tmp_path):
    config = tmp_path / "spare.toml"
    config.write_text(
        'name = "attic"\nslots = 3\ncache_mb = 77\n[labels]\nroom = "attic"\n'
        '[preferences]\nhours = "18:00-08:00"\nidle_s = 300\nmains_only = true\n'
    )
    settings = settings_of(["--config", str(config), "--slots=2", "--idle-s=60", "--label=owner=ann"])
    assert (settings.name, settings.slots, settings.cache_mb, settings.nice) == ("attic", 2, 77, 10)
    assert settings.labels == {"room": "attic", "owner": "ann"}
    chosen = settings.preferences
    assert (chosen.hours, chosen.idle_s, chosen.mains_only, chosen.max_load) == ("18:00-08:00", 60, True, 0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--hours=nights"], "--hours 'nights': expected HH:MM-HH:MM, as in 18:00-08:00"),
        (["--max-load=7"], "--max-load 7.0: input should be less than or equal to 1"),
        (["--label=attic"], "--label 'attic': expected KEY=VALUE, as in room=lab"),
        (
            ["--config=/nowhere.toml"],
            "--config /nowhere.toml: the file can't be read (No such file or directory)",
        ),
        (["--join", ""], "--join is empty, perhaps an unset variable: expected TOKEN@HOST:PORT"),
        (["--cache-mb=0"], "--cache-mb 0: input should be greater than or equal to 1"),
    ],
)
def test_wrong_preference_is_named_with_the_expected_value(arguments, said):
    result = CliRunner().invoke(app, ["run", *arguments])
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "[preferences]\nhous = '18:00-08:00'\n",
            "preferences.hous is not a setting: expected one of calm_s,",
        ),
        ("cache_mbb = 3\n", "cache_mbb is not a setting: expected one of ca, cache_dir, cache_mb,"),
    ],
)
def test_file_with_an_unknown_key_is_refused_with_the_known_ones(tmp_path, text, said):
    config = tmp_path / "spare.toml"
    config.write_text(text)
    result = CliRunner().invoke(app, ["run", f"--config={config}"])
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split())


def test_status_of_a_daemon_is_described_in_lines(tmp_path):
    StatusFile(tmp_path, "w1").write(STATUS)
    result = CliRunner().invoke(app, ["status", f"--state-dir={tmp_path}"])
    assert result.exit_code == 0
    assert f"w1 (process {os.getpid()})" in result.stdout
    assert "not connected to a manager at present" in result.stdout
    assert "0 of 4 slots run a rollout" in result.stdout


def test_status_without_workers_names_the_start_command(tmp_path):
    result = CliRunner().invoke(app, ["status", f"--state-dir={tmp_path}"])
    assert result.exit_code == 2
    assert "start one with `embomatrix worker run`" in result.stderr


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"connected_since_s": 40.0, "manager": "A:1"}, "connected to A:1 for 1 min 0 s"),
        ({"manager": "A:1"}, "not connected to A:1 at present; it keeps trying"),
        ({"paused": "on battery"}, "paused: on battery"),
        ({"running": 2}, "working"),
        ({}, "waiting for work"),
        ({"draining": True, "paused": "on battery"}, "draining: leaves after the running rollouts"),
    ],
)
def test_each_state_has_a_description(changes, said):
    lines = describe(WorkerStatus(**{**asdict(STATUS), "started_s": 0.0, **changes}), 100.0)
    assert said in [line.strip() for line in lines]


def test_status_files_of_killed_daemons_are_ignored(tmp_path):
    process = subprocess.Popen(["true"])
    process.wait()
    StatusFile(tmp_path, "dead").write(WorkerStatus("dead", process.pid, time.time()))
    StatusFile(tmp_path, "other").write(WorkerStatus("other", os.getpid(), started_s=1000.0))
    (tmp_path / "running" / "odd.json").write_text('{"name": 1}')
    StatusFile(tmp_path, "w1").write(STATUS)
    assert running_daemons(tmp_path) == [STATUS]


@pytest.fixture
def other_process():
    """Process that runs until the test ends."""
    process = subprocess.Popen(["sleep", "60"])
    yield process
    process.kill()
    process.wait()


def test_second_worker_of_one_name_is_refused_before_it_ends_the_session_of_the_first(
    tmp_path, other_process
):
    StatusFile(tmp_path, "w1").write(WorkerStatus("w1", other_process.pid, time.time(), manager="A:1"))
    arguments = ["run", f"--state-dir={tmp_path}", "--name=w1", "--manager=A:1,B:1"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    said = " ".join(result.stderr.split())
    assert f"worker 'w1' runs on this machine already (process {other_process.pid})" in said
    assert "stop that one, or give this one another --name" in said


@pytest.mark.parametrize(
    ("name", "manager", "process"), [("w2", "A:1", "other"), ("w1", "B:1", "other"), ("w1", "A:1", "own")]
)
def test_only_another_daemon_of_that_name_and_manager_is_refused(
    tmp_path, other_process, name, manager, process
):
    pid = os.getpid() if process == "own" else other_process.pid
    StatusFile(tmp_path, "w1").write(WorkerStatus("w1", pid, time.time(), manager="A:1"))
    refuse_second_daemon(tmp_path, Membership(manager, name), remedy="give this one another --name")


def test_unwritable_status_file_is_no_error(tmp_path):
    (tmp_path / "running").write_text("a file where a folder should be")
    file = StatusFile(tmp_path, "w1")
    file.write(STATUS)
    file.remove()
    assert running_daemons(tmp_path) == []


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(5.9, "5 s"), (65, "1 min 5 s"), (3 * 3600 + 720, "3 h 12 min"), (200_000, "2 d 7 h")],
)
def test_durations_have_their_two_largest_units(seconds, said):
    assert format_duration(seconds) == said


def test_unit_is_written_and_the_next_steps_are_printed(tmp_path):
    config = tmp_path / "a b%.toml"
    config.write_text('join = "secret.of.mine@host:1"\n')
    result = _install(tmp_path, "--hours", "18:00-08:00", f"--config={config}")
    assert result.exit_code == 0, result.stderr
    assert "systemctl --user enable --now embomatrix-worker.service" in result.stdout
    assert f'worker run --hours 18:00-08:00 --config "{tmp_path}/a b%%.toml"\n' in _unit(tmp_path)


def test_relative_paths_of_a_unit_become_absolute(tmp_path, monkeypatch):
    (tmp_path / "spare.toml").write_text("slots = 2\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", "/home/ann")
    result = _install(tmp_path, "--config", "spare.toml", "--cache-dir=~/cache", "--token", "@worker.token")
    assert result.exit_code == 0, result.stderr
    said = f"--config {tmp_path}/spare.toml --cache-dir /home/ann/cache --token @{tmp_path}/worker.token\n"
    assert said in _unit(tmp_path)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--join", "secret@host:1"], "every user can read a token in a unit"),
        (["--token=secret"], "every user can read a token in a unit"),
        (
            ["--config=/nowhere.toml"],
            "--config /nowhere.toml: the file can't be read (No such file or directory)",
        ),
        (["--hours=nights"], "--hours 'nights': expected HH:MM-HH:MM"),
        (["--slotz=3"], "No such option: --slotz"),
    ],
)
def test_options_that_would_fail_in_the_background_are_refused_at_install(tmp_path, words, said):
    result = _install(tmp_path, *words)
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split())
    assert "secret" not in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_system_unit_writes_to_its_state_folder(tmp_path):
    result = _install(tmp_path, "--cache-dir=/var/cache/mine", system=True)
    assert result.exit_code == 2
    assert "can write below /var/lib/embomatrix-worker only: leave --cache-dir out" in " ".join(
        result.stderr.split()
    )


def test_unprivileged_unit_gets_root_files_as_credentials():
    words = ["--config", "/etc/embomatrix/100%.toml", "--nice", "5", "--token", "@/etc/embomatrix/token"]
    text = unit_text(["/opt/embomatrix"], words, system=True)
    assert (
        "LoadCredential=config:/etc/embomatrix/100%%.toml\nLoadCredential=token:/etc/embomatrix/token\n"
        in text
    )
    handed = "--config ${CREDENTIALS_DIRECTORY}/config --nice 5 --token @${CREDENTIALS_DIRECTORY}/token"
    assert f"ExecStart=/opt/embomatrix worker run {handed}\n" in text


def test_worker_and_manager_of_a_machine_keep_their_files_apart():
    """Each service runs as a dedicated user; systemd assigns a shared state folder to the service that started last."""
    manager = (DEPLOY / "systemd" / "embomatrix-manager.service").read_text()
    folders = [
        line
        for text in (manager, unit_text(["/opt/embomatrix"], [], system=True))
        for line in text.splitlines()
        if line.startswith("StateDirectory=")
    ]
    assert len(folders) == len(set(folders)) == 2


def test_folder_closed_to_other_users_is_found(tmp_path):
    tmp_path.chmod(0o700)
    assert closed_to_others(tmp_path / "venv" / "bin" / "embomatrix") is not None
    assert closed_to_others(Path("/usr/bin/env")) is None


def _install(folder, *words, system=False):
    kind = ["--system"] if system else []
    return CliRunner().invoke(app, ["install", f"--folder={folder}", *kind, "--", *words])


def _unit(folder):
    return (folder / "embomatrix-worker.service").read_text()


def test_special_characters_are_quoted_for_systemd():
    assert [quote(word) for word in ("--nice=5", "a b", "100%", '$HOME"')] == [
        "--nice=5",
        '"a b"',
        "100%%",
        '"$$HOME\\""',
    ]


@needs_systemd
@pytest.mark.parametrize("system", [False, True])
def test_systemd_accepts_the_unit(tmp_path, system):
    path = tmp_path / "embomatrix-worker.service"
    path.write_text(
        unit_text(
            [shutil.which("true")], ["--hours", "18:00-08:00", "--config", "/etc/w.toml"], system=system
        )
    )
    assert_valid_unit(path, system=system)
