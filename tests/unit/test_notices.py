"""Each shipped file that is no code has a licence or a notice, and the wheel carries all of these."""

import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
MANIFEST = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
LICENCES = [ROOT / name for name in MANIFEST["project"]["license-files"]]
PACKAGES = [ROOT / name for name in MANIFEST["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]]
CODE = {".py", ".pyi", ".proto", ".md", ".typed", ".pyc"}
OWN = {
    "core/embomatrix/cli/cluster/report.html",
    "core/embomatrix/pages/head.html",
    "factory/embomatrix/factory/inspection/page.html",
    "factory/embomatrix/factory/language/kinds.toml",
    "factory/embomatrix/factory/language/phrases.toml",
    "factory/embomatrix/factory/social/events.toml",
    "factory/embomatrix/factory/social/people.toml",
    "manager/embomatrix/manager/web/dashboard/index.html",
    "manager/embomatrix/manager/web/dashboard/style.css",
    "trainer/embomatrix/trainer/evaluation/page.css",
    "trainer/embomatrix/trainer/evaluation/page.html",
    "trainer/embomatrix/trainer/logging/report.html",
}
"""Pages and tables that this project wrote from nothing: its own licence covers them."""
OWN_SCRIPTS = ROOT / "manager/embomatrix/manager/web/dashboard"
"""The dashboard's scripts are this project's, but for those in folders below."""


def shipped():
    return [
        file
        for package in PACKAGES
        for file in package.rglob("*")
        if file.is_file() and file.suffix not in CODE
    ]


def is_ours(file):
    return str(file.relative_to(ROOT)) in OWN or (file.suffix == ".js" and file.parent == OWN_SCRIPTS)


def covers(licence, file):
    """True if a licence text is in the file's folder, or if a notice names the file or a folder below its own."""
    if not file.is_relative_to(licence.parent) or licence.parent == ROOT:
        return False
    first = file.relative_to(licence.parent).parts[0]
    text = licence.read_text(encoding="utf-8")
    return licence.name == "LICENSE" or f"`{first}`" in text or f"`{first}/`" in text


def test_each_shipped_file_has_a_notice_or_is_this_projects_own():
    files = shipped()
    assert len(files) > len(OWN)
    bare = [
        str(file.relative_to(ROOT))
        for file in files
        if file not in LICENCES
        and not is_ours(file)
        and not any(covers(licence, file) for licence in LICENCES)
    ]
    assert bare == []


def test_files_listed_as_own_exist_and_have_no_notice():
    assert [name for name in OWN if not (ROOT / name).is_file()] == []
    assert [name for name in OWN for licence in LICENCES if covers(licence, ROOT / name)] == []


def test_wheel_carries_every_licence_and_notice():
    found = {
        file for package in PACKAGES for pattern in ("NOTICE*", "LICENSE*") for file in package.rglob(pattern)
    }
    assert {*found, ROOT / "LICENSE"} == set(LICENCES)
