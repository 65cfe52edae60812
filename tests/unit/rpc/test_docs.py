"""docs/protocol.md names every call, code and status, and the settings at their defaults."""

import re
from pathlib import Path

import pytest

from embomatrix.manager.commands.app import OPTIONS
from embomatrix.manager.services.server import SERVICES
from embomatrix.manager.settings import ManagerSettings
from embomatrix.proto.v1 import (
    admin_service_pb2,
    rollout_service_pb2,
    scene_service_pb2,
    worker_service_pb2,
)
from embomatrix.rpc.status import STATUS
from embomatrix.rpc.wire.values import InfraCode

PAGE = (Path(__file__).parents[3] / "docs" / "protocol.md").read_text(encoding="utf-8")
MODULES = (admin_service_pb2, rollout_service_pb2, scene_service_pb2, worker_service_pb2)
CALLS = {
    service.full_name: [method.name for method in service.methods]
    for module in MODULES
    for service in module.DESCRIPTOR.services_by_name.values()
}


def rows(first_heading: str) -> dict[str, str]:
    """Return the table whose first column has this heading: row names mapped to the next cell."""
    found = re.search(rf"^\| {first_heading} \|.*\n\| ---.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert found, f"docs/protocol.md has no table of {first_heading}"
    cells = [line.strip("|").split(" | ") for line in found[1].splitlines()]
    return {name.strip(" `"): value for name, value, *_ in cells}


def test_every_service_is_checked():
    assert set(CALLS) == set(SERVICES)


@pytest.mark.parametrize("service", CALLS)
def test_every_call_is_documented(service: str):
    assert f"`{service.rpartition('.')[2]}`" in PAGE
    assert [call for call in CALLS[service] if f"`{call}`" not in PAGE] == []


def test_every_infrastructure_failure_code_is_documented():
    assert list(rows("code")) == [*InfraCode]


def test_every_status_is_documented():
    assert list(rows("status")) == [code.name for code in STATUS.values()]


def test_settings_are_documented_with_their_defaults():
    settings = ManagerSettings()
    written = {name: float(value) for name, value in rows("setting of the manager").items()}
    assert written == {name: getattr(settings, name) for name in written}
    assert ManagerSettings.model_fields.keys() - OPTIONS - {"token"} <= set(written)
