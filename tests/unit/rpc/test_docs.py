"""docs/protocol.md names every call, code and status, and the settings at their defaults."""

import re
from pathlib import Path

import pytest
from google.protobuf.descriptor import FieldDescriptor

from embomatrix.manager.commands.app import OPTIONS
from embomatrix.manager.services.server import SERVICES
from embomatrix.manager.settings import ManagerSettings
from embomatrix.proto.v1 import (
    admin_service_pb2,
    rollout_service_pb2,
    scene_service_pb2,
    types_pb2,
    worker_service_pb2,
)
from embomatrix.rpc.status import STATUS
from embomatrix.rpc.wire.rollout import SKILL_KINDS
from embomatrix.rpc.wire.values import InfraCode
from embomatrix.skills.syntax import SIGNATURES, Arg, Skill

PAGE = (Path(__file__).parents[3] / "docs" / "protocol.md").read_text(encoding="utf-8")
MODULES = (admin_service_pb2, rollout_service_pb2, scene_service_pb2, worker_service_pb2)
CALLS = {
    service.full_name: [method.name for method in service.methods]
    for module in MODULES
    for service in module.DESCRIPTOR.services_by_name.values()
}


def rows(*headings: str) -> dict[str, str]:
    """Return the table whose first columns have these headings: row names mapped to the next cell."""
    first = r" \| ".join(headings)
    found = re.search(rf"^\| {first} \|.*\n\| ---.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert found, f"docs/protocol.md has no table of {first}"
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


def test_every_call_of_a_plan_is_documented_with_its_number_and_fields():
    found = re.search(r"^\| action in JSON \|.*\n\| ---.*\n((?:\|.*\n)+)", PAGE, re.MULTILINE)
    assert found
    written = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in found[1].splitlines()]
    assert written == [
        [
            f"`{skill}`",
            f"`SKILL_KIND_{skill.name}`",
            str(SKILL_KINDS[skill]),
            ", ".join(f"`{arg}`" for arg in SIGNATURES[skill]),
        ]
        for skill in Skill
    ]


def test_every_argument_of_a_call_is_documented_with_its_type():
    types = {
        FieldDescriptor.TYPE_INT64: "int64",
        FieldDescriptor.TYPE_STRING: "string",
        FieldDescriptor.TYPE_DOUBLE: "double",
    }
    fields = types_pb2.SkillCall.DESCRIPTOR.fields_by_name
    documented = {
        name.strip("`"): kind.strip()
        for cell, kind in rows("field", "type").items()
        for name in cell.split(", ")
    }
    assert documented == {arg.value: types[fields[arg.value].type] for arg in Arg}


def test_every_field_of_a_result_is_documented():
    named = " ".join(rows("field of a result"))
    for message in (
        worker_service_pb2.LeaseResult,
        types_pb2.Completed,
        types_pb2.Reward,
        types_pb2.StepResult,
        types_pb2.Timings,
    ):
        fields = set(message.DESCRIPTOR.fields_by_name)
        assert {name for name in fields if not re.search(rf"\b{name}\b", named)} <= {"completed", "timings"}
