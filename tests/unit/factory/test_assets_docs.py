"""docs/assets.md counts the families and names every rule of the asset check."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import fields
from pathlib import Path

from embomatrix.factory.assets.check import AssetRule
from embomatrix.factory.assets.families import Family
from embomatrix.factory.assets.library import family_of
from embomatrix.world.asset import Asset
from embomatrix.world.catalog import Catalog

PAGE = (Path(__file__).parents[3] / "docs" / "assets.md").read_text(encoding="utf-8")


def rows(first_heading: str) -> list[list[str]]:
    found = re.search(rf"^\| {first_heading} \|.*\n\| ---.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert found, f"docs/assets.md has no table of {first_heading}"
    return [[cell.strip() for cell in line.strip("|").split(" | ")] for line in found[1].splitlines()]


def test_table_of_families_counts_every_category_in_use_once() -> None:
    catalog = Catalog.load()
    counts = Counter(family_of(catalog, name) for name in catalog.used_categories)
    listed: list[Family] = []
    for kind, names, number in rows("kind"):
        found = [Family(name) for name in re.findall(r"`(\w+)`", names)]
        listed += found
        assert sum(counts[family] for family in found) == int(number.strip(" |")), kind
    assert sorted(listed) == sorted(Family)
    assert (
        f"{len(catalog.category_names):,} categories of solid objects {len(catalog.used_categories):,} occur"
        in PAGE
    )


def test_every_rule_has_its_row() -> None:
    assert [name.strip("` ") for name, _ in rows("rule")] == list(AssetRule)


def test_fields_of_the_page_are_those_of_an_asset() -> None:
    named = {name.strip("` ") for name, _ in rows("field")} - {"link` of both"}
    assert named <= {field.name for field in fields(Asset)}
