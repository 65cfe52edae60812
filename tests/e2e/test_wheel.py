"""The wheel is complete: built as a release builds it, installed without clone and network, it plays a shipped task."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from packaging.metadata import Metadata

from embomatrix.bench.first_hour.wheel import install

ROOT = Path(__file__).parents[2]
SOURCES = ("core", "proto", "manager", "worker", "trainer", "factory", "bench")
NO_NETWORK = dict.fromkeys(("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"), "http://127.0.0.1:9")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """Wheel built from the source distribution."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)]
    built = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    assert len(list(out.glob("*.tar.gz"))) == 1
    (found,) = out.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """Virtual environment with the wheel and the dependencies of the tests' environment, but not the clone."""
    return install(wheel, tmp_path_factory.mktemp("environment"))


def tracked_files():
    folders = [f"{source}/embomatrix" for source in SOURCES]
    listed = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", *folders], capture_output=True, text=True, check=True
    )
    return {name.split("/", 1)[1] for name in listed.stdout.splitlines()}


def test_wheel_contains_exactly_the_tracked_files_of_the_packages(wheel):
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == tracked_files()


def test_every_package_says_that_it_is_typed(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    packages = {
        "/".join(name.split("/")[:2]) for name in names if name.count("/") > 1 and name.endswith(".py")
    }
    assert {package for package in packages if f"{package}/py.typed" not in names} == set()


def test_metadata_is_what_an_index_accepts(wheel):
    archive = zipfile.ZipFile(wheel)
    info = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
    metadata = Metadata.from_email(archive.read(info), validate=True)
    assert metadata.name == "embomatrix"
    assert metadata.license_expression == "MIT"
    assert metadata.description.startswith("# EmboMatrix")
    for file in metadata.license_files:
        assert archive.read(info.replace("METADATA", f"licenses/{file}"))


def test_installed_wheel_plays_a_shipped_task_with_the_shipped_policy(environment, tmp_path):
    command = [
        str(environment / "bin/embomatrix"),
        "play",
        "put the apple in the fridge",
        "--policy",
        "shipped",
    ]
    played = subprocess.run(
        command,
        cwd=tmp_path,
        env={**os.environ, **NO_NETWORK, "XDG_CACHE_HOME": str(tmp_path / "cache"), "COLUMNS": "160"},
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert played.returncode == 0, played.stderr
    assert "move meat_loaf_1" in played.stdout
    assert "the text is a plan" in played.stdout
    where = "import embomatrix.cli, embomatrix.trainer; print(embomatrix.cli.__path__, embomatrix.trainer.__path__)"
    found = subprocess.run(
        [str(environment / "bin/python"), "-c", where],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert str(ROOT) not in found.stdout
