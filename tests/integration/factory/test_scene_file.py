"""Scene files: built scenes are shown, drawn and checked again; other files are rejected in a sentence."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from embomatrix.factory.commands.scenes import app
from embomatrix.factory.scenes.scene_file import MAX_BYTES, SceneFileError, read_scene, write_scene
from embomatrix.world.codec import scene_to_json
from embomatrix.world.geometry import Pose

if TYPE_CHECKING:
    from pathlib import Path

    from embomatrix.world.scene import Scene


@pytest.fixture
def path(flat: Scene, tmp_path: Path) -> Path:
    path = tmp_path / "built.json"
    write_scene(path, flat)
    return path


def test_scene_is_read_back_equal_and_its_file_is_far_below_the_limit(flat: Scene, path: Path) -> None:
    assert read_scene(path) == flat
    assert path.stat().st_size * 40 < MAX_BYTES


def test_scene_in_a_file_is_shown_and_drawn(flat: Scene, path: Path) -> None:
    shown = CliRunner().invoke(app, ["show", str(path)])
    assert shown.exit_code == 0, shown.output
    assert all(room.name in shown.output for room in flat.rooms)
    drawn = CliRunner().invoke(app, ["draw", str(path), "--as", "sheet", "--out", str(path.parent)])
    assert drawn.exit_code == 0, drawn.output
    assert (path.parent / "sheet.png").read_bytes().startswith(b"\x89PNG")


def test_file_is_checked_once_with_its_own_seed(flat: Scene, path: Path) -> None:
    borne = next(item for item in flat.objects if item.host and not item.fixed)
    x, y, z = borne.pose_world_asset.position_m
    hanging = replace(borne, pose_world_asset=Pose((x, y, z + 0.2), borne.pose_world_asset.quat_xyzw))
    lifted = replace(flat, objects=tuple(hanging if item is borne else item for item in flat.objects), seed=7)
    write_scene(path, lifted)
    report = path.parent / "report.json"
    result = CliRunner().invoke(
        app, ["check", str(path), "--seed", "0", "--seed", "1", "--report", str(report)]
    )
    assert result.exit_code == 1
    (entry,) = json.loads(report.read_text())
    assert (entry["scene_id"], entry["seed"]) == (flat.scene_id, 7)
    assert ["floating", borne.name] in [[kind, names[0]] for kind, names, _ in entry["problems"]]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "is not JSON"),
        (b"\x00\xff\xfe", "is not JSON"),
        (b"[" * 100_000, "is not JSON"),
        (b"[]", "scene"),
        (b'{"objects": []}', "scene"),
    ],
)
def test_file_without_a_scene_is_rejected_in_a_sentence(tmp_path: Path, data: bytes, words: str) -> None:
    path = tmp_path / "bad.json"
    path.write_bytes(data)
    with pytest.raises(SceneFileError, match=words):
        read_scene(path)


@pytest.mark.parametrize("name", ["../../etc/passwd", "/dev/zero", "a/b"])
def test_path_is_never_used_as_a_scene_name(flat: Scene, tmp_path: Path, name: str) -> None:
    path = tmp_path / "bad.json"
    path.write_text(json.dumps({**scene_to_json(flat), "scene_id": name}))
    result = CliRunner().invoke(app, ["draw", str(path), "--out", str(tmp_path / "pictures")])
    assert result.exit_code == 2
    assert "scene.scene_id" in result.output
    assert not (tmp_path / "pictures").exists()


def test_oversized_file_is_rejected_before_reading(tmp_path: Path) -> None:
    path = tmp_path / "big.json"
    with path.open("wb") as file:
        file.truncate(1 << 30)
    for command in ("check", "draw"):
        result = CliRunner().invoke(app, [command, str(path)])
        assert result.exit_code == 2, result.output
        assert "over 67,108,864 bytes" in result.output


@pytest.mark.parametrize("name", ["nowhere.json", "folder.json"])
def test_missing_file_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder.json").mkdir()
    result = CliRunner().invoke(app, ["check", str(tmp_path / name)])
    assert result.exit_code == 2
    assert f"{name} is not a file" in result.output


def test_build_accepts_only_names(path: Path) -> None:
    result = CliRunner().invoke(app, ["build", str(path), "--out", str(path.parent / "out")])
    assert result.exit_code == 2
    assert "is no floor plan: expected the name of a base scene" in result.output
    assert not (path.parent / "out").exists()
