"""docs/glossary.md lists every message of the protocol and every class of the control package and of the engine."""

import ast
import re
from pathlib import Path

import pytest

from embomatrix.proto.v1 import (
    admin_service_pb2,
    rollout_service_pb2,
    scene_service_pb2,
    types_pb2,
    worker_service_pb2,
)

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "glossary.md").read_text(encoding="utf-8")
LISTED = dict(re.findall(r"^\| `(\w+)` \| [^|]+ \| (.+) \|$", PAGE, re.MULTILINE))
PROTOCOL = (admin_service_pb2, rollout_service_pb2, scene_service_pb2, types_pb2, worker_service_pb2)
FOLDERS = ("manager/embomatrix/manager/control", "core/embomatrix/sim")


def protocol_names() -> set[str]:
    """Return the names of the protocol's messages, enums and services."""
    files = [module.DESCRIPTOR for module in PROTOCOL]
    return {
        name
        for file in files
        for names in (file.message_types_by_name, file.enum_types_by_name, file.services_by_name)
        for name in names
    }


def class_names(folder: str) -> set[str]:
    """Return the public top-level classes below a folder."""
    return {
        node.name
        for path in (ROOT / folder).rglob("*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    }


def test_glossary_lists_every_message_of_the_protocol():
    assert protocol_names() - set(LISTED) == set()


@pytest.mark.parametrize("folder", FOLDERS)
def test_glossary_lists_every_public_class(folder: str):
    names = class_names(folder)
    assert names
    assert names - set(LISTED) == set()


def test_glossary_lists_only_existing_names():
    known = protocol_names().union(*map(class_names, FOLDERS))
    assert set(LISTED) - known == set()


def test_every_entry_of_the_glossary_has_a_meaning():
    assert [name for name, meaning in LISTED.items() if not meaning.strip()] == []
