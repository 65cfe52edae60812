"""URDF import: models keep their joints; invalid files are rejected with the wrong element."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from embomatrix.factory.importers.assemble import import_model, read_model
from embomatrix.factory.importers.convex import by_components
from embomatrix.factory.importers.model import ModelFileError
from embomatrix.factory.importers.urdf import read_urdf
from embomatrix.world.asset import Credit
from embomatrix.world.catalog import Catalog

if TYPE_CHECKING:
    from pathlib import Path


def urdf(tmp_path: Path, body: str) -> Path:
    path = tmp_path / "thing.urdf"
    path.write_text(f'<robot name="thing">{body}</robot>')
    return path


def link(name: str, extra: str = "", size: str = "1 1 1") -> str:
    shape = f'<collision><geometry><box size="{size}"/></geometry></collision>'
    return f'<link name="{name}">{shape}{extra}</link>'


def joint(name: str, parent: str, child: str, kind: str = "fixed", extra: str = "") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{extra}</joint>'


def test_urdf_keeps_its_joint_and_merges_fixed_links(tmp_path: Path) -> None:
    limits = '<limit lower="0" upper="1.2"/><axis xyz="0 0 1"/><origin xyz="0.5 -0.5 0" rpy="0 0 0"/>'
    path = urdf(
        tmp_path,
        link("body") + link("plinth", size="1 1 0.2") + link("door", size="0.05 1 1")
        + joint("foot", "body", "plinth", extra='<origin xyz="0 0 -0.6"/>')
        + joint("swing", "body", "door", "revolute", limits),
    )  # fmt: skip
    credit = Credit("A. Maker", "CC0-1.0", "a drawing")
    raw = read_model(path)
    asset = import_model(Catalog.load(), raw, "bottom_cabinet", "songes", credit, by_components).asset
    assert [item.name for item in asset.links] == ["base", "door"]
    assert len(asset.links[0].parts) == 2
    assert asset.joints[0][1].upper == pytest.approx(1.2)
    assert asset.joints[0][1].axis == (0.0, 0.0, 1.0)


@pytest.mark.parametrize(
    ("body", "message"),
    [
        (link("a") + link("b"), "found the links 'a', 'b' without a parent"),
        (link("a") + link("b") + joint("j", "a", "b") + joint("k", "b", "a"), "form a cycle"),
        (link("a") + link("b") + link("c") + joint("j", "b", "c") + joint("k", "c", "b"), "form a cycle without a connection"),
        (link("a") + joint("j", "a", "ghost"), "the child of the joint 'j' is 'ghost': expected the name of a link"),
        (link("a") + link("b") + link("c") + joint("j", "a", "c") + joint("k", "b", "c"), "has two parents"),
        (link("a") + link("a"), "two links are named 'a'"),
        (link("a", '<inertial><mass value="-2"/></inertial>'), "the mass of the link 'a' is negative"),
        (link("a", size="1 nan 1"), "expected 3 finite numbers"),
        (link("a", size="1 1"), "expected 3 finite numbers"),
        (link("a", size="-1 1 1"), "size is '-1 1 1', expected metres above 0"),
        (link("a", size="1 0 1"), "expected metres above 0"),
        (link("a", size="1 1e30 1"), "at most 100"),
        ("".join(link(f"l{number}") for number in range(200)), "it has 200 links"),
        ("<link", "is not XML"),
        (link("a") + link("b") + joint("j", "a", "b", "planar"), "of type 'planar'"),
        (link("a") + link("b") + joint("j", "a", "b", "revolute"), "has no travel"),
        ('<link name="a"/>', "the link 'a' has no shape"),
        ("", "it has 0 links"),
        ('<link name="a"><visual><geometry><cone/></geometry></visual></link>', "is a 'cone'"),
        ('<link name="a"><visual><geometry><mesh filename="../x.obj"/></geometry></visual></link>', "outside the URDF's"),
        ('<link name="a"><visual><geometry><mesh filename="/etc/x.obj"/></geometry></visual></link>', "outside the URDF's"),
        ('<link name="a"><visual><geometry><mesh filename="x.obj"/></geometry></visual></link>', "can't be read"),
    ],
)  # fmt: skip
def test_urdf_that_is_no_tree_or_leaves_its_folder_is_rejected(
    tmp_path: Path, body: str, message: str
) -> None:
    with pytest.raises(ModelFileError, match=message):
        read_urdf(urdf(tmp_path, body))


def test_moving_link_on_a_moving_link_is_refused(tmp_path: Path) -> None:
    limit = '<limit lower="0" upper="1"/>'
    joints = joint("j", "a", "b", "revolute", limit) + joint("k", "b", "c", "prismatic", limit)
    with pytest.raises(ModelFileError, match="the joint 'k' moves on the moving link 'b'"):
        read_urdf(urdf(tmp_path, link("a") + link("b") + link("c") + joints))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16"])
def test_entities_are_rejected_in_any_encoding(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "bomb.urdf"
    bomb = '<!DOCTYPE r [<!ENTITY a "aaaa">]><robot name="&a;"/>'
    path.write_bytes(f'<?xml version="1.0" encoding="{encoding}"?>{bomb}'.encode(encoding))
    with pytest.raises(ModelFileError, match=r"declares entities|is not UTF-8"):
        read_urdf(path)
