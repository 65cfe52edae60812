"""Source layout that imports and decisions rely on."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCE_ROOTS = ("core", "proto", "manager", "worker", "factory", "trainer")


@pytest.mark.parametrize("root", SOURCE_ROOTS)
def test_source_root_is_a_namespace_without_init(root):
    assert not (ROOT / root / "embomatrix" / "__init__.py").exists(), "it would hide the other roots"


def test_manager_and_trainer_import_without_a_physics_engine():
    program = (
        "import sys, importlib.abc\n"
        "class Bar(importlib.abc.MetaPathFinder):\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        "        if name.split('.')[0] == 'pybullet' or name.startswith('embomatrix.sim'):\n"
        "            raise ModuleNotFoundError(name, name=name)\n"
        "sys.meta_path.insert(0, Bar())\n"
        "import embomatrix.manager.commands.app, embomatrix.manager.services.app\n"
        "import embomatrix.trainer.commands.train, embomatrix.trainer.run.loop\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, timeout=120)


def test_index_lists_every_decision_by_its_title():
    folder = ROOT / "docs" / "decisions"
    pages = sorted(page for page in folder.glob("*.md") if page.name != "README.md")
    titles = [
        page.read_text(encoding="utf-8").splitlines()[0].removeprefix("# ").split(": ", 1) for page in pages
    ]
    listed = [
        line for line in (folder / "README.md").read_text(encoding="utf-8").splitlines() if line[:1] == "*"
    ]
    assert listed == [
        f"* [{number}]({page.name}): {title}" for page, (number, title) in zip(pages, titles, strict=True)
    ]
    assert all(page.name.startswith(number) for page, (number, _) in zip(pages, titles, strict=True))
