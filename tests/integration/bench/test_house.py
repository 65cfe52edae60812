"""Figures of the code base: each counts what its name says, and the check of openings reports like a linter."""

import importlib.util
import json
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
_SPEC = importlib.util.spec_from_file_location("house", ROOT / "bench" / "house.py")
house = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(house)

SOURCE = '''"""Module docstring.

It has three lines."""

import os  # counts


# a comment
def start() -> str:
    """Return a name."""
    "a bare string"
    text = """a
value"""
    return text
'''


@pytest.fixture
def checkout(tmp_path):
    def write(**files):
        for name, text in files.items():
            path = tmp_path / name.replace("__", "/").replace("_py", ".py")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        subprocess.run(("git", "init", "-q"), cwd=tmp_path, check=True)
        subprocess.run(("git", "add", "."), cwd=tmp_path, check=True)
        return tmp_path

    return write


def test_code_lines_leave_out_blank_lines_comments_and_bare_strings():
    assert house.count_code_lines(SOURCE) == 5


def test_only_tracked_files_count_and_no_stubs(checkout):
    root = checkout(core__a_py="A = 1\n", core__a_pb2_py="B = 1\n")
    (root / "core" / "new.py").write_text("C = 1\n")
    assert set(house.read_sources(root)) == {"core/a.py"}


def test_modules_that_import_each_other_are_a_cycle_even_under_type_checking():
    sources = {
        "core/embomatrix/a.py": "from embomatrix.b import B\n",
        "core/embomatrix/b.py": "if TYPE_CHECKING:\n    from embomatrix import a\n",
        "core/embomatrix/c.py": "import embomatrix.a\n",
    }
    assert house.import_cycles(sources) == [["embomatrix.a", "embomatrix.b"]]


def test_private_and_nested_classes_do_not_clash():
    sources = {
        "core/a.py": "class Shared: ...\nclass _Hidden: ...\n",
        "core/b.py": "class Shared: ...\nclass _Hidden: ...\nclass Outer:\n    class Only: ...\n",
        "core/c.py": "class Only: ...\n",
    }
    assert house.name_clashes(sources) == {"Shared": ["core/a.py", "core/b.py"]}


@pytest.mark.parametrize("text", ["What it is.", "how it is done", "In a folder.", "Of all rollouts."])
def test_openings_with_a_banned_word_are_reported_with_path_and_line(text):
    source = f'"""Module."""\n\n\ndef function():\n    """{text}"""\n'
    [found] = house.banned_openings({"core/a.py": source})
    assert found.startswith(f"core/a.py:5: the docstring opens with '{text.split()[0]}'")


@pytest.mark.parametrize(
    ("source", "line"), [('A = 1\n"""{}"""\n', 2), ('class B:\n    x: int = 0\n    """{}"""\n', 3)]
)
def test_openings_of_constants_and_attributes_are_checked_too(source, line):
    [found] = house.banned_openings({"core/a.py": source.format("By scene: how many.")})
    assert found.split(": ")[0] == f"core/a.py:{line}"


@pytest.mark.parametrize(
    "text", ["Whatever is left.", "Internal error.", "Tokens of a plan.", "True if empty."]
)
def test_other_openings_are_allowed(text):
    assert house.banned_openings({"core/a.py": f'"""{text}"""\n'}) == []


def test_check_of_openings_exits_with_1_if_it_finds_any(checkout, capsys):
    root = checkout(core__a_py='"""What it is."""\n', docs__b_py='"""What it is."""\n')
    assert house.main(["--check-openings", "--root", str(root)]) == 1
    assert [line.split(": ")[0] for line in capsys.readouterr().out.splitlines()] == ["core/a.py:1"]
    (root / "core" / "a.py").write_text('"""Fact."""\n')
    assert house.main(["--check-openings", "--root", str(root)]) == 0


def test_code_figures_use_the_common_benchmark_format(checkout, tmp_path):
    code = "class Shared:\n    '''Of two.'''\n"
    root = checkout(core__x__a_py=code, core__x__b_py=code, tests__test_a_py="class Shared: ...\n")
    path = tmp_path / "house.json"
    assert house.main(["--no-tests", "--root", str(root), "--json", str(path)]) == 0
    written = json.loads(path.read_text())
    assert written["bench"] == "house"
    assert {figure["name"]: figure["value"] for figure in written["figures"]} == {
        "code_lines_non_test": 2,
        "modules_flat_max": 2,
        "import_cycles": 0,
        "public_name_clashes": 1,
        "banned_openings": 2,
    }


def test_arguments_of_make_house_do_not_reach_the_unit_tests(tmp_path, monkeypatch):
    (tmp_path / "Makefile").write_text('test-unit:\n\ttest -z "$(ARGS)"\n')
    # Variables of make's command line reach a make below it in this way.
    monkeypatch.setenv("MAKEFLAGS", "-- ARGS=--json\\ figures.json")
    assert house.time_unit_tests(tmp_path) > 0
