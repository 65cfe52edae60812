"""A spare PC at the command line: preferences from options and a file, status in words, a unit for systemd."""

import os
import shutil
import subprocess
import time
from dataclasses import asdict
from pathlib import Path

import pytest
import typer
from tests.fakes.systemd import assert_valid_unit, needs_systemd
from typer.testing import CliRunner

from embomatrix.worker.cli import app
from embomatrix.worker.install_cli import quote, unit_text
from embomatrix.worker.run_cli import run, values_of
from embomatrix.worker.settings_cli import parse
from embomatrix.worker.status import StatusFile, WorkerStatus, running_daemons
from embomatrix.worker.status_cli import describe, spell

STATUS = WorkerStatus("w1", os.getpid(), time.time(), slots=4, memory_mb=2000, cache_mb=1024)


def _settings(*arguments):
    """The settings that `worker run` makes of these arguments, without running it."""
    command = typer.main.get_command(_only_run())
    context = command.make_context("run", list(arguments))
    return parse(values_of(context, context.params["config"], context.params["labels"] or []))


def _only_run():
    parser = typer.Typer()
    parser.command()(run)
    return parser


def test_options_go_before_the_file_and_the_file_before_defaults(tmp_path):
    config = tmp_path / "spare.toml"
    config.write_text(
        'name = "attic"\nslots = 3\ncache_mb = 77\n[labels]\nroom = "attic"\n'
        '[preferences]\nhours = "18:00-08:00"\nidle_s = 300\nmains_only = true\n'
    )
    settings = _settings("--config", str(config), "--slots=2", "--idle-s=60", "--label=owner=ann")
    assert (settings.name, settings.slots, settings.cache_mb, settings.nice) == ("attic", 2, 77, 10)
    assert settings.labels == {"room": "attic", "owner": "ann"}
    wishes = settings.preferences
    assert (wishes.hours, wishes.idle_s, wishes.mains_only, wishes.max_load) == ("18:00-08:00", 60, True, 0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--hours=nights"], "--hours 'nights': expected HH:MM-HH:MM, as in 18:00-08:00"),
        (["--max-load=7"], "--max-load 7.0: input should be less than or equal to 1"),
        (["--label=attic"], "--label 'attic': expected KEY=VALUE, as in room=lab"),
        (["--config=/nowhere.toml"], "--config /nowhere.toml: No such file or directory"),
        (["--cache-mb=0"], "--cache-mb 0: input should be greater than or equal to 1"),
    ],
)
def test_a_wrong_preference_is_named_with_what_was_expected(arguments, said):
    result = CliRunner().invoke(app, ["run", *arguments])
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[preferences]\nhous = '18:00-08:00'\n", "preferences.hous is no setting: expected one of calm_s,"),
        ("cache_mbb = 3\n", "cache_mbb is no setting: expected one of ca, cache_dir, cache_mb,"),
    ],
)
def test_a_file_with_a_key_that_is_none_is_refused_and_told_those_that_there_are(tmp_path, text, said):
    config = tmp_path / "spare.toml"
    config.write_text(text)
    result = CliRunner().invoke(app, ["run", f"--config={config}"])
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split())


def test_the_status_of_a_daemon_is_told_in_words(tmp_path):
    StatusFile(tmp_path, "w1").write(STATUS)
    result = CliRunner().invoke(app, ["status", f"--state-dir={tmp_path}"])
    assert result.exit_code == 0
    assert f"w1 (process {os.getpid()})" in result.stdout
    assert "not connected to a manager at present" in result.stdout
    assert "0 of 4 slots run a rollout" in result.stdout


def test_where_no_worker_runs_the_status_says_how_to_start_one(tmp_path):
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
        ({"draining": True, "paused": "on battery"}, "draining: leaves when what runs has ended"),
    ],
)
def test_each_standing_has_its_words(changes, said):
    lines = describe(WorkerStatus(**{**asdict(STATUS), "started_s": 0.0, **changes}), 100.0)
    assert said in [line.strip() for line in lines]


def test_what_a_killed_daemon_left_is_passed_over(tmp_path):
    process = subprocess.Popen(["true"])
    process.wait()
    StatusFile(tmp_path, "dead").write(WorkerStatus("dead", process.pid, time.time()))
    StatusFile(tmp_path, "other").write(WorkerStatus("other", os.getpid(), started_s=1000.0))
    (tmp_path / "running" / "odd.json").write_text('{"name": 1}')
    StatusFile(tmp_path, "w1").write(STATUS)
    assert running_daemons(tmp_path) == [STATUS]


def test_a_status_that_cannot_be_written_is_no_error(tmp_path):
    (tmp_path / "running").write_text("a file where a folder should be")
    file = StatusFile(tmp_path, "w1")
    file.write(STATUS)
    file.remove()
    assert running_daemons(tmp_path) == []


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(5.9, "5 s"), (65, "1 min 5 s"), (3 * 3600 + 720, "3 h 12 min"), (200_000, "2 d 7 h")],
)
def test_durations_are_told_in_their_two_largest_units(seconds, said):
    assert spell(seconds) == said


def test_a_unit_is_written_and_the_next_steps_are_said(tmp_path):
    result = CliRunner().invoke(
        app, ["install", f"--folder={tmp_path}", "--", "--hours", "18:00-08:00", "--config", "/a b%.toml"]
    )
    assert result.exit_code == 0, result.stderr
    assert "systemctl --user enable --now embomatrix-worker.service" in result.stdout
    text = (tmp_path / "embomatrix-worker.service").read_text()
    assert 'worker run --hours 18:00-08:00 --config "/a b%%.toml"\n' in text


def test_a_token_is_not_written_into_a_unit(tmp_path):
    result = CliRunner().invoke(app, ["install", f"--folder={tmp_path}", "--", "--join", "secret@host:1"])
    assert result.exit_code == 2
    assert "secret" not in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_words_of_a_command_are_taken_literally():
    assert [quote(word) for word in ("--nice=5", "a b", "100%", '$HOME"')] == [
        "--nice=5",
        '"a b"',
        "100%%",
        '"$$HOME\\""',
    ]


@needs_systemd
@pytest.mark.parametrize("system", [False, True])
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path, system):
    path = tmp_path / "embomatrix-worker.service"
    path.write_text(unit_text([str(Path(shutil.which("true")))], ["--hours", "18:00-08:00"], system=system))
    assert_valid_unit(path, system=system)
