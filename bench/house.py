"""Figures of the code base itself: size, layout, import cycles, names, docstring openings, time of the unit tests.

`python bench/house.py` prints a table, and `--json FILE` writes it as every benchmark does.
`python bench/house.py --check-openings` is the check of CI: it lists docstrings that open with a banned word.
"""

import argparse
import ast
import re
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from embomatrix.pages.figures import Better, Figure

ROOTS: Final = ("core", "manager", "worker", "trainer", "factory", "bench")
BANNED: Final = re.compile(
    r"(what|who|whose|whom|where|how|which|when|whether|why|that|of|as|to|from|in|on|at|by|for|with|into|over|between)\b",
    re.IGNORECASE,
)
"""Relative clauses and bare prepositions: a docstring starts with a noun or a verb."""


def read_sources(root: Path) -> dict[str, str]:
    """Text of every tracked Python file by its path below ``root``, without generated protobuf stubs."""
    listed = subprocess.run(
        ("git", "-C", str(root), "ls-files", "-z", "*.py"), capture_output=True, text=True, check=True
    )
    paths = (path for path in listed.stdout.split("\0") if path and "_pb2" not in path)
    return {path: (root / path).read_text(encoding="utf-8") for path in paths if (root / path).is_file()}


def count_code_lines(source: str) -> int:
    """Count lines that are neither blank, nor a comment, nor part of a docstring or another bare string."""
    prose: set[int] = set()
    for node, _ in _bare_strings(source):
        prose.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    lines = enumerate(source.splitlines(), start=1)
    return sum(
        bool(text := line.strip()) and text[0] != "#" and number not in prose for number, line in lines
    )


def _bare_strings(source: str) -> Iterator[tuple[ast.Expr, str]]:
    """Statements that are only a string: docstrings of modules, classes, functions, attributes and constants."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Expr(value=ast.Constant(value=str(text))):
                yield node, text


def import_cycles(sources: Mapping[str, str]) -> list[list[str]]:
    """Groups of modules that import one another, imports under TYPE_CHECKING included."""
    import networkx

    modules = {".".join(Path(path).with_suffix("").parts[1:]): text for path, text in sources.items()}
    graph = networkx.DiGraph(
        (module, target)
        for module, text in modules.items()
        for target in _imports(text)
        if target in modules and target != module
    )
    return [sorted(group) for group in networkx.strongly_connected_components(graph) if len(group) > 1]


def _imports(source: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def name_clashes(sources: Mapping[str, str]) -> dict[str, list[str]]:
    """Public top-level classes that several modules define, with the paths of these modules."""
    homes: dict[str, list[str]] = defaultdict(list)
    for path, text in sources.items():
        for node in ast.parse(text).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                homes[node.name].append(path)
    return {name: paths for name, paths in homes.items() if len(paths) > 1}


def banned_openings(sources: Mapping[str, str]) -> list[str]:
    """Docstrings, those of attributes included, that open with a banned word, as ``path:line: message``."""
    return [
        f"{path}:{node.lineno}: the docstring opens with {words[0]!r}: expected a noun or a verb"
        for path, source in sources.items()
        for node, text in _bare_strings(source)
        if (words := BANNED.match(text.strip()))
    ]


def house_figures(sources: Mapping[str, str], unit_test_s: float | None) -> tuple[Figure, ...]:
    """All figures; the time of the unit tests only if it was measured."""
    code = {path: text for path, text in sources.items() if not path.startswith("tests/")}
    packages = below(code, ROOTS)
    folders = Counter(str(Path(path).parent) for path in code)
    documented = below(sources, (*ROOTS, "tests"))
    lines = sum(map(count_code_lines, code.values()))

    def lower(name: str, value: float, unit: str, goal: float, count: int) -> Figure:
        return Figure(name, value, unit, Better.LOWER, count, goal)

    figures = (
        lower("code_lines_non_test", lines, "lines", 62_500, len(code)),
        lower("modules_flat_max", max(folders.values()), "modules", 25, len(folders)),
        lower("import_cycles", len(import_cycles(packages)), "cycles", 0, len(packages)),
        lower("public_name_clashes", len(name_clashes(packages)), "names", 0, len(packages)),
        lower("banned_openings", len(banned_openings(documented)), "docstrings", 0, len(documented)),
    )
    return figures if unit_test_s is None else (*figures, lower("unit_test_s", unit_test_s, "s", 60, 1))


def below(sources: Mapping[str, str], roots: Iterable[str]) -> dict[str, str]:
    """Sources below these top-level folders."""
    prefixes = tuple(f"{root}/" for root in roots)
    return {path: text for path, text in sources.items() if path.startswith(prefixes)}


def time_unit_tests(root: Path) -> float:
    """Run ``make test-unit`` and return its wall time in seconds. Raises CalledProcessError if a test fails."""
    started_s = time.monotonic()
    subprocess.run(("make", "-C", str(root), "test-unit", "ARGS="), check=True, stdout=sys.stderr)
    return time.monotonic() - started_s


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line and return the exit status."""
    parser = argparse.ArgumentParser(description="Measure size, layout and language of this code base.")
    parser.add_argument("--json", type=Path, help="write the figures to this file as well")
    parser.add_argument("--no-tests", action="store_true", help="leave out the time of the unit tests")
    parser.add_argument("--check-openings", action="store_true", help="only list banned docstring openings")
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[1], help="checkout to measure")
    options = parser.parse_args(arguments)
    sources = read_sources(options.root)
    if options.check_openings:
        openings = banned_openings(below(sources, (*ROOTS, "tests")))
        sys.stdout.writelines(f"{line}\n" for line in openings)
        return int(bool(openings))
    from embomatrix.bench.report.figures import BenchResult, describe_machine
    from embomatrix.bench.report.output import hand_in
    from embomatrix.host.code_version import commit_here

    machine = describe_machine()
    unit_test_s = None if options.no_tests else time_unit_tests(options.root)
    hand_in(BenchResult("house", commit_here(), machine, house_figures(sources, unit_test_s)), options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
