"""A20: no message carries a wall-clock time, so wrong clocks do no harm."""

from google.protobuf.descriptor import FieldDescriptor

from embomatrix.proto.v1 import (
    admin_service_pb2,
    rollout_service_pb2,
    scene_service_pb2,
    types_pb2,
    worker_service_pb2,
)

MODULES = (admin_service_pb2, rollout_service_pb2, scene_service_pb2, types_pb2, worker_service_pb2)
SHOWN_TO_PEOPLE = {"RunEvent.at_s", "LoggedEvent.at_s"}
CLOCKS = ("timestamp", "_at", "at_s", "clock", "date", "unix", "now", "until", "expires")


def fields():
    for module in MODULES:
        for message in module.DESCRIPTOR.message_types_by_name.values():
            for field in message.fields:
                yield f"{message.name}.{field.name}", field


def test_no_message_carries_a_wall_clock_time():
    clock_fields = [
        name for name, _ in fields() if any(part in name.split(".")[1].split("_") for part in CLOCKS)
    ]
    clock_fields += [name for name, _ in fields() if name.endswith(("_at", "_at_s", "_until_s", "_ts"))]
    assert set(clock_fields) <= SHOWN_TO_PEOPLE
    types = {f.message_type.full_name for _, f in fields() if f.type == FieldDescriptor.TYPE_MESSAGE}
    assert not {name for name in types if name.startswith("google.protobuf.Timestamp")}
