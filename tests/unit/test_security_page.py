"""docs/security.md names only tests that exist, and a test for every threat or the reason why there is none."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")


def test_every_test_that_the_page_names_exists():
    defined = {
        node.name
        for path in (ROOT / "tests").rglob("test_*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    }
    files = {path.name for path in (ROOT / "tests").rglob("test_*.py")}
    names = set(re.findall(r"\btest_\w+(?:\.py)?", PAGE))
    missing = {name for name in names if name not in (files if name.endswith(".py") else defined)}
    assert names
    assert missing == set()
