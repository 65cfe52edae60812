"""Writes are atomic and reads are bounded."""

from pathlib import Path

import pytest

from embomatrix.world.whole_file import read_whole, write_whole


def test_file_is_written_and_nothing_else_remains(tmp_path: Path) -> None:
    write_whole(tmp_path / "a.json", b"new")
    assert [(path.name, path.read_bytes()) for path in tmp_path.iterdir()] == [("a.json", b"new")]


def test_file_with_a_mode_ignores_a_left_over_part(tmp_path: Path) -> None:
    (tmp_path / "key.part").write_bytes(b"readable by all")
    write_whole(tmp_path / "key", b"secret", mode=0o600)
    assert [(path.name, path.stat().st_mode & 0o777) for path in tmp_path.iterdir()] == [("key", 0o600)]


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "taken"
    (target / "inner").mkdir(parents=True)
    with pytest.raises(OSError):
        write_whole(target, b"new")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_file_beyond_the_size_limit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b"four")
    assert read_whole(path, at_most=4) == b"four"
    with pytest.raises(OSError, match="over 3 bytes"):
        read_whole(path, at_most=3)


def test_endless_file_is_refused() -> None:
    with pytest.raises(OSError, match="over 1,000 bytes"):
        read_whole(Path("/dev/zero"), at_most=1_000)
