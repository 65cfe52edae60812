"""Commands run in the foreground of another one: failures and exit status."""

import pytest

from embomatrix.cli import local_cluster
from embomatrix.cli.local_cluster import no_problem, run_command


def leave_by(monkeypatch, script):
    monkeypatch.setattr(local_cluster, "embomatrix_command", lambda *_: ["sh", "-c", script])


@pytest.mark.parametrize(
    ("number", "expected"),
    [
        (
            9,
            "signal 9 (Killed), as the system does when memory runs out: what it had saved is kept, give the",
        ),
        (15, "signal 15 (Terminated): what it had saved is kept"),
    ],
)
def test_command_ended_by_a_signal_is_reported(monkeypatch, capsys, number, expected):
    leave_by(monkeypatch, f"kill -{number} $$")
    with pytest.raises(SystemExit) as left:
        run_command("experiment", no_problem, "train", "--seed=0")
    assert left.value.code == 2
    said = capsys.readouterr().err
    assert "embomatrix experiment: `embomatrix train` was ended from outside by" in said
    assert expected in said


def test_failed_command_passes_its_status_on(monkeypatch, capsys):
    leave_by(monkeypatch, "exit 7")
    with pytest.raises(SystemExit) as left:
        run_command("experiment", no_problem, "train")
    assert left.value.code == 7
    assert capsys.readouterr().err == ""


def test_successful_command_returns(monkeypatch):
    leave_by(monkeypatch, "exit 0")
    run_command("experiment", no_problem, "train")
