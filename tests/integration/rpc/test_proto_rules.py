"""`proto/check.sh` finds breaking changes, and runs in any clone."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
BUF = Path(sys.executable).with_name("buf")
FIELD = "  string release = 1;\n"
PROTO = """syntax = "proto3";

package embomatrix.proto.v1;

service NoteService {
  rpc Note(NoteRequest) returns (NoteResponse);
}

message NoteRequest {
  string release = 1;
}

message NoteResponse {}
"""


def git(folder, *arguments):
    identity = ("-c", "user.name=Ann", "-c", "user.email=ann@lab.example", "-c", "init.defaultBranch=main")
    subprocess.run(["git", *identity, *arguments], cwd=folder, check=True, capture_output=True)


def commit(folder, proto):
    (folder / "proto/embomatrix/proto/v1/note_service.proto").write_text(proto)
    git(folder, "add", "-A")
    git(folder, "commit", "-m", "change")


@pytest.fixture
def repository(tmp_path):
    """Repository with one commit, a small protocol and our rules."""
    if not BUF.exists():
        pytest.fail(f"{BUF} is missing: install the extra dev: its wheel buf-bin provides it")
    folder = tmp_path / "repository"
    (folder / "proto/embomatrix/proto/v1").mkdir(parents=True)
    for name in ("check.sh", "buf.yaml"):
        shutil.copy(ROOT / "proto" / name, folder / "proto" / name)
    git(tmp_path, "init", str(folder))
    commit(folder, PROTO)
    return folder


def checked(folder):
    return subprocess.run(
        [str(folder / "proto/check.sh"), str(BUF)], cwd=folder, capture_output=True, text=True, check=False
    )


def test_first_commit_reports_a_missing_baseline(repository):
    result = checked(repository)
    assert result.returncode == 0, result.stderr
    assert "skipped, this checkout has one commit only" in result.stdout


def test_adding_a_field_passes_and_removing_one_fails(repository):
    commit(repository, PROTO.replace(FIELD, f"{FIELD}  string more = 2;\n"))
    assert "nothing broken since" in checked(repository).stdout
    git(repository, "checkout", "-b", "work")
    commit(repository, PROTO.replace(FIELD, "  string more = 2;\n"))
    result = checked(repository)
    assert result.returncode != 0
    assert 'field "1" with name "release"' in result.stdout


def test_shallow_clone_is_linted(repository, tmp_path):
    commit(repository, PROTO.replace("NoteService", "Notes"))
    git(tmp_path, "clone", "--depth=1", f"file://{repository}", "shallow")
    result = checked(tmp_path / "shallow")
    assert result.returncode != 0
    assert "Notes" in result.stdout
    assert "breaking" not in result.stdout
