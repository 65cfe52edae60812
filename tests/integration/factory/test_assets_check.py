"""Checks of all assets in use, and of assets with a known flaw."""

from __future__ import annotations

from dataclasses import replace

import pytest
from typer.testing import CliRunner

from embomatrix.factory.assets.check import EXCUSED_FROM_PROBE, PROBE_M, AssetFinding, AssetRule, check_asset
from embomatrix.factory.assets.families import Family
from embomatrix.factory.assets.library import build_asset, family_of
from embomatrix.factory.commands.assets import app
from embomatrix.factory.pictures.assets import TILE_PX, draw_sheet
from embomatrix.world.asset import Asset, Interior, Joint, JointKind, Link
from embomatrix.world.catalog import Catalog
from embomatrix.world.geometry import ConvexPart, Pose, Shape

CATALOG = Catalog.load()
PLAIN_BOXES = 160
"""Upper limit for categories in use that are a plain box: sheets, thin rods, flat fittings, dice."""


def first_of(category: str) -> Asset:
    return build_asset(CATALOG, category, CATALOG.models_of(category)[0].model_id)


def box_at(center: tuple[float, float, float], size: tuple[float, float, float]) -> ConvexPart:
    return ConvexPart(Shape.BOX, Pose(center), size)


def wrong(findings: tuple[AssetFinding, ...]) -> list[AssetRule]:
    return [finding.rule for finding in findings if not finding.excused]


def test_categories_in_use_are_those_of_scenes_and_activities() -> None:
    used = CATALOG.used_categories
    assert len(used) == 1428
    assert {"fridge", "apple", "door", "bath_towel"} <= set(used)


def test_three_models_of_every_category_in_use_pass() -> None:
    assert not wrong_ones(most=3)


@pytest.mark.slow
def test_every_model_of_every_category_in_use_passes() -> None:
    assert not wrong_ones(most=None)


def wrong_ones(most: int | None) -> list[str]:
    """Return the violations among the first ``most`` models of each category in use."""
    return [
        f"{category}-{model.model_id}"
        for category in CATALOG.used_categories
        for model in CATALOG.models_of(category)[:most]
        if wrong(check_asset(CATALOG, build_asset(CATALOG, category, model.model_id)))
    ]


def test_sliced_food_has_the_shape_of_a_part_of_the_whole() -> None:
    kinds = {
        name: family_of(CATALOG, name)
        for name in (
            "half_apple",
            "half_pizza",
            "half_butter",
            "half_baguette",
            "sliced_cucumber",
            "half_log",
        )
    }
    assert kinds == {
        "half_apple": Family.HALF_FOOD,
        "half_pizza": Family.HALF_FOOD,
        "half_butter": Family.SLAB,
        "half_baguette": Family.BREAD,
        "sliced_cucumber": Family.DISC,
        "half_log": Family.BAR,
    }


def test_few_categories_are_plain_boxes() -> None:
    plain = [name for name in CATALOG.used_categories if family_of(CATALOG, name) is Family.BLOCK]
    assert len(plain) <= PLAIN_BOXES


def test_every_exemption_from_the_probe_is_needed_and_has_a_reason() -> None:
    excused = {
        family_of(CATALOG, name)
        for name in CATALOG.used_categories
        if any(f.rule is AssetRule.FILLABLE and f.excused for f in check_asset(CATALOG, first_of(name)))
    }
    assert all(EXCUSED_FROM_PROBE.values())
    assert set(EXCUSED_FROM_PROBE) <= excused


def test_model_of_wrong_size_is_reported() -> None:
    apple = first_of("apple")
    taller = replace(apple, size_m=(*apple.size_m[:2], apple.size_m[2] * 1.06))
    assert wrong(check_asset(CATALOG, taller)) == [AssetRule.SIZE]
    assert not check_asset(CATALOG, replace(apple, size_m=(*apple.size_m[:2], apple.size_m[2] * 1.04)))


def test_too_narrow_cavity_is_reported() -> None:
    bucket = first_of("bucket")
    slit = Interior("inside", (0.0, 0.0, 0.0), (0.1, PROBE_M - 1e-3, 0.1))
    (finding,) = check_asset(CATALOG, replace(bucket, interiors=(slit,)))
    assert (finding.rule, finding.excused) == (AssetRule.FILLABLE, False)
    assert "0.029 m wide" in finding.detail


def test_door_that_penetrates_its_frame_is_reported() -> None:
    fridge = first_of("fridge")
    base, door = fridge.links
    assert door.joint is not None
    inward = replace(door, joint=replace(door.joint, axis=(0.0, 0.0, 1.0)))
    (finding,) = check_asset(CATALOG, replace(fridge, links=(base, inward)))
    assert finding.rule is AssetRule.OPENABLE
    assert finding.detail.startswith("door at 5% of its travel")


def test_overlapping_drawers_are_reported() -> None:
    fridge = first_of("fridge")
    out, side = Joint(JointKind.PRISMATIC, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.4), (0.0, 1.0, 0.0)
    one = Link("one", (box_at((0.0, 0.0, 0.0), (0.1, 0.1, 0.1)),), out)
    other = Link("other", (box_at((0.3, -0.2, 0.0), (0.1, 0.1, 0.1)),), replace(out, axis=side))
    base = Link("base", (box_at((0.0, 0.0, -0.3), (0.2, 0.2, 0.1)),))
    findings = check_asset(CATALOG, replace(fridge, links=(base, one, other)))
    assert AssetRule.OPENABLE in wrong(findings)


def test_openable_asset_without_a_joint_is_reported() -> None:
    fridge = first_of("fridge")
    assert AssetRule.OPENABLE in wrong(check_asset(CATALOG, replace(fridge, links=fridge.links[:1])))


def test_sheet_shows_an_asset_closed_and_open() -> None:
    picture = draw_sheet([first_of("apple"), first_of("fridge")], columns=3)
    assert picture.width == 3 * TILE_PX
    grey = picture.convert("L")
    for tile in range(3):
        dark = grey.crop((tile * TILE_PX, 0, (tile + 1) * TILE_PX, TILE_PX)).point(lambda v: v < 230 and 255)
        assert dark.getbbox() is not None


def test_check_prints_the_rules_and_names_an_unknown_category() -> None:
    pytest.importorskip("pybullet", reason="PyBullet has wheels up to Python 3.11 on x86-64")
    result = CliRunner().invoke(app, ["check", "--category", "bowl", "--category", "fridge"])
    assert result.exit_code == 0, result.output
    assert "2 models" in result.output
    assert "2 categories" in result.output
    unknown = CliRunner().invoke(app, ["check", "--category", "frigde"])
    assert unknown.exit_code == 2
    assert "did you mean fridge" in unknown.output


def test_categories_are_listed_by_name_and_by_kind():
    by_name = CliRunner().invoke(app, ["list", "cabinet"], env={"COLUMNS": "80"})
    assert "bottom_cabinet_no_top" in by_name.output
    assert "locker" in by_name.output  # a kind of cabinet
    assert "opens" in by_name.output
    assert max(map(len, by_name.output.splitlines())) <= 80
    by_words = CliRunner().invoke(app, ["list", "coffee table"])
    assert "coffee_table" in by_words.output
    every = CliRunner().invoke(app, ["list"])
    count = len(Catalog.load().category_names)
    assert f"{count:,} of {count:,} categories" in every.output
