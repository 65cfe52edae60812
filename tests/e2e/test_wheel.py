"""The wheel is complete: built as a release builds it, installed without clone and network, it plays a shipped task.

The source distribution holds what builds, tests and documents the package.
"""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest
from packaging.metadata import Metadata

from embomatrix.bench.first_hour.wheel import EXTRAS, PLAY, install

ROOT = Path(__file__).parents[2]
SOURCES = ("core", "proto", "manager", "worker", "trainer", "factory", "bench")
NO_NETWORK = dict.fromkeys(("http_proxy", "https_proxy", "HTTP_PROXY", "HTTPS_PROXY"), "http://127.0.0.1:9")


@pytest.fixture(scope="module")
def distributions(tmp_path_factory):
    """Folder with the source distribution and the wheel built from it."""
    out = tmp_path_factory.mktemp("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(out), str(ROOT)]
    built = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert built.returncode == 0, built.stdout + built.stderr
    return out


@pytest.fixture(scope="module")
def wheel(distributions):
    (found,) = distributions.glob("*.whl")
    return found


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """Virtual environment with the wheel and what two of its extras require, but neither the clone nor any other package."""
    return install(wheel, EXTRAS, tmp_path_factory.mktemp("environment"))


def tracked_files(*folders):
    """Files that git tracks. Without git, in an unpacked source distribution, nothing tells which files belong to it."""
    if not (ROOT / ".git").exists():
        pytest.skip("the tests run outside a clone")
    listed = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", *folders], capture_output=True, text=True, check=True
    )
    return set(listed.stdout.splitlines())


def outside_the_clone():
    """Environment variables without a path to the clone's modules."""
    return {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}


def test_wheel_contains_exactly_the_tracked_files_of_the_packages(wheel):
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    tracked = tracked_files(*(f"{source}/embomatrix" for source in SOURCES))
    assert names == {name.split("/", 1)[1] for name in tracked}


def test_source_distribution_contains_exactly_the_tracked_files_but_those_of_ci(distributions):
    (archive,) = distributions.glob("*.tar.gz")
    with tarfile.open(archive) as opened:
        names = {name.split("/", 1)[1] for name in opened.getnames()}
    assert names - {"PKG-INFO"} == {name for name in tracked_files() if not name.startswith(".ci/")}


def test_version_is_that_of_the_tag_and_a_development_version_after_it(tmp_path):
    def run(*command):
        return subprocess.run(
            command, cwd=tmp_path, capture_output=True, text=True, check=True
        ).stdout.strip()

    def commit():
        run("git", "-c", "user.name=a", "-c", "user.email=a@b", "commit", "--allow-empty", "-qm", "change")

    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    run("git", "init", "-q")
    run("git", "add", ".")
    commit()
    run("git", "tag", "v0.2.0")
    assert run(sys.executable, "-m", "hatchling", "version") == "0.2.0"
    commit()
    assert run(sys.executable, "-m", "hatchling", "version") == "0.2.1.dev1"


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
    assert metadata.description_content_type == "text/markdown"
    assert "manager/embomatrix/manager/web/dashboard/vendor/LICENSE" in metadata.license_files
    for file in metadata.license_files:
        assert archive.read(info.replace("METADATA", f"licenses/{file}"))


def test_installed_wheel_plays_a_shipped_task_with_the_shipped_policy(environment, tmp_path):
    played = subprocess.run(
        [str(environment / "bin/embomatrix"), *PLAY],
        cwd=tmp_path,
        env={
            **outside_the_clone(),
            **NO_NETWORK,
            "XDG_CACHE_HOME": str(tmp_path / "cache"),
            "COLUMNS": "160",
        },
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert played.returncode == 0, played.stderr
    assert "toggle_on floor_lamp_1" in played.stdout
    assert "the text is a plan" in played.stdout
    where = "import embomatrix.cli, embomatrix.trainer; print(embomatrix.cli.__path__, embomatrix.trainer.__path__)"
    found = subprocess.run(
        [str(environment / "bin/python"), "-c", where],
        cwd=tmp_path,
        env=outside_the_clone(),
        capture_output=True,
        text=True,
        check=True,
    )
    assert str(ROOT) not in found.stdout


def test_command_of_another_extra_names_it(environment, tmp_path):
    refused = subprocess.run(
        [str(environment / "bin/embomatrix"), "manager", "serve"],
        cwd=tmp_path,
        env=outside_the_clone(),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert refused.returncode == 2
    assert "pip install 'embomatrix[manager]'" in refused.stderr
