"""Terminal commands that ask a manager whose every text is hostile."""

import json
from concurrent.futures import ThreadPoolExecutor

import grpc
import pytest
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message_factory import GetMessageClass
from tests.fakes.commands import run

from embomatrix.proto.v1 import admin_service_pb2, rollout_service_pb2
from embomatrix.rpc.wire.bounds import is_repeated

EVIL = "[/bold][red]\x1b]0;owned\x07\x1b[2J\u009b31m\u202e\nforged: all is well"
CONTROL = frozenset("\x1b\x07\u009b\u202e")
COMMANDS = (
    "status",
    "top --rounds=1",
    "cluster workers",
    "cluster runs",
    "cluster runs --closed",
    "cluster plan",
    "cluster events",
    "cluster explain x",
    "manager token list",
    "manager token issue --role=trainer",
)
VALUES = {
    FieldDescriptor.CPPTYPE_STRING: EVIL,
    FieldDescriptor.CPPTYPE_BOOL: True,
    FieldDescriptor.CPPTYPE_FLOAT: 1.0,
    FieldDescriptor.CPPTYPE_DOUBLE: 1.0,
}
PROTOCOL = 2
"""Value of numbers and enumerations, and the version of the protocol."""
MODULES = (admin_service_pb2, rollout_service_pb2)


def hostile(message):
    """Fill the fields of a message, with one element in each list and ``EVIL`` in each text."""
    for field in message.DESCRIPTOR.fields:
        value = VALUES.get(field.cpp_type, PROTOCOL)
        is_list = is_repeated(field)
        if field.message_type is not None and field.message_type.GetOptions().map_entry:
            continue
        if field.message_type is not None:
            place = getattr(message, field.name)
            hostile(place.add() if is_list else place)
        elif is_list:
            getattr(message, field.name).append(value)
        elif field.type != FieldDescriptor.TYPE_BYTES:
            setattr(message, field.name, value)
    return message


def handler(method):
    """Return the handler of a method. Logs have one page."""
    request, response = (GetMessageClass(kind) for kind in (method.input_type, method.output_type))

    def answer(asked, _context):
        return response() if getattr(asked, "after", 0) else hostile(response())

    return grpc.unary_unary_rpc_method_handler(answer, request.FromString, response.SerializeToString)


@pytest.fixture(scope="module")
def address():
    server = grpc.server(ThreadPoolExecutor(4))
    for module in MODULES:
        for service in module.DESCRIPTOR.services_by_name.values():
            handlers = {method.name: handler(method) for method in service.methods}
            server.add_generic_rpc_handlers(
                [grpc.method_handlers_generic_handler(service.full_name, handlers)]
            )
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    yield f"127.0.0.1:{port}"
    server.stop(0).wait()


@pytest.mark.parametrize("command", COMMANDS)
def test_texts_of_a_manager_are_shown_as_text(address, command):
    shown = run(*command.split(), f"--manager={address}", COLUMNS="200")
    assert shown.status == 0, shown.text
    assert "[/bold]" in shown.text
    assert not CONTROL & set(shown.text)


@pytest.mark.parametrize("command", ["status", "cluster runs", "cluster explain x"])
def test_json_of_a_manager_has_no_control_characters_and_the_same_values(address, command):
    shown = run(*command.split(), "--json", f"--manager={address}")
    assert not CONTROL & set(shown.text)
    assert EVIL in texts(json.loads(shown.text))


def test_doctor_shows_the_texts_of_a_manager_as_text(address):
    shown = run("doctor", f"--manager={address}", COLUMNS="200")
    assert "forged" in shown.text
    assert "Traceback" not in shown.text
    assert not CONTROL & set(shown.text)


def texts(value):
    """Yield the strings of a JSON value."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict | list):
        for part in value.values() if isinstance(value, dict) else value:
            yield from texts(part)
