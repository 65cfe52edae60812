"""Shared head of self-contained pages."""

import re
from importlib.resources import files

import pytest

from embomatrix.pages.head import page_head

PAGES = (
    ("embomatrix.cli.cluster", "report.html"),
    ("embomatrix.factory.inspection", "page.html"),
    ("embomatrix.trainer.evaluation", "page.html"),
)


def test_title_is_escaped_and_nothing_is_fetched():
    head = page_head("</title><script>alert(1)</script> $title")
    assert "<script" not in head
    assert "&lt;script&gt;alert(1)&lt;/script&gt; $title</title>" in head
    assert re.findall(r'(?:href|src)="([^"]*)"', head) == ["data:,"]


@pytest.mark.parametrize(("package", "name"), PAGES)
def test_page_colours_are_defined_for_light_and_dark(package, name):
    page = page_head("a page") + files(package).joinpath(name).read_text(encoding="utf-8")
    used = set(re.findall(r"var\(--(\w+)\)", page))
    given = re.findall(r"--(\w+):", page)
    assert used
    assert {colour for colour in used if given.count(colour) != 2} == set()
