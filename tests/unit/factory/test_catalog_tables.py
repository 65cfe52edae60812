"""Shipped tables equal those derived from the bddl package."""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
from importlib import resources
from typing import TYPE_CHECKING

import pytest

from embomatrix.factory.catalog_tables import (
    CATALOG_FILE,
    NOTICE_FILE,
    SCENES_FILE,
    SUBSTANCES_FILE,
    CatalogSourceError,
    encode,
    source_folder,
)

if TYPE_CHECKING:
    from pathlib import Path

SHIPPED = resources.files("embomatrix.world").joinpath("data")


@pytest.fixture(scope="module")
def rebuilt(tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        source_folder()
    except CatalogSourceError as error:
        pytest.skip(str(error))
    out = tmp_path_factory.mktemp("tables")
    command = [sys.executable, "-m", "embomatrix.factory.catalog_tables", "--out", str(out)]
    subprocess.run(command, check=True)
    return out


@pytest.mark.parametrize("name", [CATALOG_FILE, SCENES_FILE, SUBSTANCES_FILE])
def test_rebuilt_table_equals_the_shipped_one(rebuilt: Path, name: str) -> None:
    # values, not bytes: another zlib may compress the same text differently
    fresh, shipped = (rebuilt / name).read_bytes(), SHIPPED.joinpath(name).read_bytes()
    assert json.loads(gzip.decompress(fresh)) == json.loads(gzip.decompress(shipped))


def test_notice_carries_the_licence_and_its_copyright_line(rebuilt: Path) -> None:
    text = SHIPPED.joinpath(NOTICE_FILE).read_text(encoding="utf-8")
    assert text == (rebuilt / NOTICE_FILE).read_text(encoding="utf-8")
    assert "Copyright (c) 2021 Stanford Vision and Learning Lab" in text
    assert "Permission is hereby granted" in text


def test_tables_stay_small() -> None:
    assert sum(len(SHIPPED.joinpath(name).read_bytes()) for name in (CATALOG_FILE, SCENES_FILE)) < 1_500_000


def test_equal_tables_give_equal_bytes() -> None:
    assert encode({"b": 1, "a": [2.5]}) == encode({"a": [2.5], "b": 1})
    assert gzip.decompress(encode({"b": 1, "a": 2})) == b'{"a":2,"b":1}'
