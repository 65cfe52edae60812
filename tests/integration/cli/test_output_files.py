"""Commands make the folder of a file that they are asked to write, and refuse a path that can't be written before they work."""

import errno
import os
import re
import shlex
from pathlib import Path

import pytest
from tests.fakes.terminal import typed
from tests.integration.cli.test_dataset_option import commands

from embomatrix.host.failure import unwritable
from embomatrix.host.own_files import prepare_output

TASK = "apple_to_counter"
EXPERIMENT = "--dataset K --out runs --arm grpo:"
WRITERS = (
    "bench engine --json OUT",
    "bench cluster --json OUT",
    "bench simulation --json OUT",
    "bench trainer --json OUT",
    "bench operations --json OUT",
    "bench first-hour --json OUT",
    "bench first-hour --record OUT",
    "bench pictures --json OUT",
    "bench traffic --json OUT",
    "bench adversary --json OUT",
    "bench fidelity --quick --json OUT",
    "bench all --out OUT",
    "bench page results.json --out OUT",
    "cluster report run --out OUT",
    "cluster trace run --out OUT",
    "eai judge answers.json OUT",
    f"experiment learning {EXPERIMENT} --json OUT",
    f"experiment learning {EXPERIMENT} --page OUT",
    f"experiment times {EXPERIMENT} --json OUT",
    f"experiment times {EXPERIMENT} --page OUT",
    f"experiment compare {EXPERIMENT} --json OUT",
    f"experiment compare {EXPERIMENT} --page OUT",
    "experiment table --run runs --bench eai --json OUT",
    "experiment table --run runs --bench eai --page OUT",
    "factory import --bddl one.bddl --bind-only --report OUT",
    "factory import --bddl one.bddl --bind-only --json OUT",
    "factory import --bddl one.bddl --bind-only --outcomes OUT",
    "factory try one.bddl --page OUT",
    f"factory inspect {TASK} --dataset K --out OUT",
    "factory corpus --freeze OUT",
    "factory search --dataset K --out picked --freeze OUT",
    "factory evaluate scenes --outcomes OUT",
    "factory evaluate aesthetics --calibration OUT",
    "factory evaluate lies --page OUT",
    "factory verify --dataset K --json OUT",
    "factory audit --dataset K --json OUT",
    "factory prompts --dataset K --out OUT",
    "factory export --dataset K --out OUT.jsonl",
    "factory conversations --dataset K --split heldout --out OUT.jsonl",
    "factory assets draw --category apple --out OUT",
    f"play {TASK} --dataset K --oracle --film OUT.gif",
    "scene build Rs_int --report OUT",
    "scene import house.json --out OUT",
    "scene check Rs_int --report OUT",
    "train --dataset K --record OUT",
)
"""Every option and argument that names a file to write. K stands for a dataset, OUT for the file."""
WRITES = re.compile(
    r"\bfile for\b|\bto write\b|\bpage (to (update|append)|with)\b|\bappended to\b|\bto this file\b",
    re.IGNORECASE,
)
QUICK = (
    "factory import --bddl one.bddl --scene Rs_int --bind-only --report OUT --json OUT2 --outcomes OUT3",
    f"factory inspect {TASK} --dataset K --no-picture --out OUT",
    "factory verify --dataset K --json OUT --jobs 1",
    "factory evaluate lies --page OUT",
    "factory prompts --dataset K --out OUT",
    "factory export --dataset K --out OUT.jsonl",
    "factory conversations --dataset K --split heldout --out OUT.jsonl",
    "factory assets draw --category apple --out OUT",
    "scene import house.json --out OUT",
)


def run(line: str, kitchen: Path, out: Path) -> tuple[int, str]:
    """Run the command; return its exit status and what it printed, in one line."""
    words = [re.sub(r"^OUT", str(out), re.sub(r"^K$", str(kitchen), word)) for word in shlex.split(line)]
    status, text = typed(shlex.join(words))
    return status, " ".join(text.split())


@pytest.mark.parametrize("line", WRITERS)
def test_a_path_below_a_file_is_refused(line: str, kitchen: Path, place: Path) -> None:
    before = {path for path in place.rglob("*") if "home" not in path.parts}
    out = place / "file" / "out"
    status, text = run(line, kitchen, out)
    if not line.startswith("cluster"):  # these connect first, and no manager is here
        assert f"{out}" in text
        assert f"can't be written (Not a directory): {place / 'file'} is a file; name another path" in text
    assert status == 2
    assert {path for path in place.rglob("*") if path.is_file() and "home" not in path.parts} <= before


def test_every_option_that_names_a_file_to_write_is_tested() -> None:
    named = {
        (name, each.opts[0] if each.param_type_name == "option" else each.name)
        for name, command in commands()
        for each in command.params
        if WRITES.search(each.help or "") and not (each.help or "").startswith("Folder")
    }
    tested = set()
    for line in WRITERS:
        words = shlex.split(line)
        name = next(found for found, _ in commands() if line.startswith(f"{found} "))
        option = words[next(at for at, word in enumerate(words) if word.startswith("OUT")) - 1]
        tested.add((name, option if option.startswith("--") else "out"))
    assert named == tested


@pytest.mark.parametrize("line", QUICK)
def test_the_folder_of_the_file_is_made(line: str, kitchen: Path, place: Path) -> None:
    out = place / "new" / "folder" / "out"
    status, text = run(line, kitchen, out)
    assert status == 0, text
    for word in shlex.split(line):
        if word.startswith("OUT"):
            assert Path(word.replace("OUT", str(out))).stat().st_size, text


def test_an_output_is_checked_without_leaving_a_file(tmp_path: Path) -> None:
    kept = tmp_path / "a.json"
    kept.write_bytes(b"old")
    prepare_output("train", kept, None, tmp_path / "new" / "b.json")
    assert {path.name for path in tmp_path.rglob("*")} == {"a.json", "new"}
    assert kept.read_bytes() == b"old"


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("", "(Is a directory): name another path"),
        ("file/a.json", "is a file; name another path"),
        ("file/b/a.json", "is a file; name another path"),
        ("x" * 300, "(File name too long): name a shorter path"),
        ("pipe", "(Not a regular file): name another path"),
    ],
)
def test_an_output_that_can_not_be_written_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, words: str
) -> None:
    (tmp_path / "file").write_text("a file")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(SystemExit) as done:
        prepare_output("train", tmp_path / name)
    assert done.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith(f"embomatrix train: {tmp_path / name} can't be written")
    assert message.rstrip().endswith(words)


@pytest.mark.parametrize(
    ("number", "remedy"),
    [
        (errno.ENOSPC, "free disk space, or name another path"),
        (errno.EACCES, "fix the permissions, or name another path"),
        (errno.EROFS, "name a path on another file system"),
    ],
)
def test_the_remedy_is_that_of_the_reason(tmp_path: Path, number: int, remedy: str) -> None:
    error = OSError(number, os.strerror(number))
    assert unwritable(tmp_path, error) == f"{tmp_path} can't be written ({os.strerror(number)}): {remedy}"
