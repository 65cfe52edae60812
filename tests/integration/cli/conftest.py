"""Inputs of the command lines that tests type."""

import json
from pathlib import Path

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from tests.integration.message_cases import BDDL


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small dataset."""
    folder = tmp_path_factory.mktemp("data") / "K"
    write_kitchen_dataset(folder)
    return folder


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working folder with inputs and a file named `file`, and a home of its own."""
    (tmp_path / "one.bddl").write_text(
        BDDL.replace("inside apple.n.01_1 counter", "nextto apple.n.01_1 counter")
    )
    (tmp_path / "one.toml").write_text(
        'instruction = "i"\ngoal = "(open fridge_1)"\n[objects]\nfridge_1 = "inroom kitchen"\n'
    )
    square = [{"x": x, "z": z} for x, z in ((0, 0), (0, 4), (4, 4), (4, 0))]
    room = {"id": "room|1", "roomType": "Kitchen", "floorPolygon": square}
    (tmp_path / "house.json").write_text(json.dumps({"rooms": [room]}))
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\n"
    (tmp_path / "good.obj").write_text(f"{corners}f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    (tmp_path / "file").write_text("a file")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("COLUMNS", "1000")
    return tmp_path
