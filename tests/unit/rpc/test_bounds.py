"""Every field that a manager receives has a bound, and no value beyond it passes."""

import contextlib
import math
from pathlib import Path

import pytest
from google.protobuf.descriptor import FieldDescriptor
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.proto.v1 import (
    admin_service_pb2,
    rollout_service_pb2,
    scene_service_pb2,
    types_pb2,
    worker_service_pb2,
)
from embomatrix.rpc.wire.bounds import (
    BOUNDS,
    MESSAGE_BYTES,
    RESULT_BYTES,
    bounds_table,
    check,
    check_result,
    is_map,
    is_repeated,
    parsed,
)
from embomatrix.rpc.wire.codec import ConvertError

MODULES = (worker_service_pb2, rollout_service_pb2, admin_service_pb2, scene_service_pb2)


def received_fields():
    """Yield each field of each message that a manager receives, nested ones included."""
    waiting = [
        method.input_type
        for module in MODULES
        for service in module.DESCRIPTOR.services_by_name.values()
        for method in service.methods
    ]
    seen = set()
    while waiting:
        descriptor = waiting.pop()
        if descriptor.full_name in seen:
            continue
        seen.add(descriptor.full_name)
        for field in descriptor.fields:
            yield field
            if field.message_type is not None and not is_map(field):
                waiting.append(field.message_type)


def needs_bound(field):
    single_message = field.message_type is not None and not is_repeated(field) and not is_map(field)
    return not single_message and field.cpp_type != FieldDescriptor.CPPTYPE_BOOL


def test_every_received_field_has_a_bound_and_every_bound_a_field():
    named = {
        f"{field.containing_type.name}.{field.name}" for field in received_fields() if needs_bound(field)
    }
    assert named == set(BOUNDS)


def test_protocol_page_lists_the_bounds():
    page = Path(__file__).parents[3] / "docs" / "protocol.md"
    assert bounds_table() in page.read_text(), "put the text of bounds_table() into docs/protocol.md"


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -1.0, 1e308])
def test_no_load_or_memory_beyond_its_bound_passes(value):
    with pytest.raises(ConvertError, match="load"):
        check(worker_service_pb2.HeartbeatRequest(load=value))
    resident = worker_service_pb2.Resident(memory_mb=value)
    state = worker_service_pb2.WorkerState(residents=[resident])
    with pytest.raises(ConvertError, match=r"residents\[0\].memory_mb"):
        check(state)


def test_large_labels_and_many_residents_are_refused():
    resources = types_pb2.Resources(slots=1, labels={"a": "x" * 20_000_000})
    with pytest.raises(ConvertError, match="20,000,000 characters"):
        check(worker_service_pb2.RegisterRequest(worker_id="w", resources=resources))
    many = worker_service_pb2.WorkerState(residents=[worker_service_pb2.Resident()] * 200_000)
    with pytest.raises(ConvertError, match="200,000 elements: expected at most 4,096"):
        check(many)


def test_message_of_too_many_bytes_is_refused_before_it_is_parsed():
    most = MESSAGE_BYTES["SessionRequest"]
    with pytest.raises(ConvertError, match="expected at most 4,194,304"):
        parsed(worker_service_pb2.SessionRequest, b"\xff" * (most + 1))


def test_result_of_too_many_bytes_is_refused():
    result = worker_service_pb2.LeaseResult()
    result.completed.final_state.append("x" * RESULT_BYTES)
    with pytest.raises(ConvertError, match="expected at most 65,536"):
        check_result(result)


@given(st.binary(max_size=200))
def test_arbitrary_bytes_parse_or_raise_a_malformed_message(data):
    for kind in (
        worker_service_pb2.SessionRequest,
        worker_service_pb2.RegisterRequest,
        rollout_service_pb2.ExecuteRequest,
    ):
        with contextlib.suppress(ConvertError):
            parsed(kind, data)
