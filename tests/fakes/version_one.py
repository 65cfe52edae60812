"""The version before: what passes here has the fields of protocol 1 and no others, whoever wrote it.

``tests/data/protocol_1.binpb`` describes the messages of the release that spoke it, as its own .proto files did:
``protoc --include_imports --descriptor_set_out=protocol_1.binpb embomatrix/proto/v1/*.proto``.
"""

import contextlib
from dataclasses import dataclass
from pathlib import Path

import grpc
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from tests.fakes.manager import FakeManager

from embomatrix.rpc.channel import SERVER_OPTIONS
from embomatrix.rpc.status import PreconditionError, translate

DESCRIPTION = Path(__file__).parents[1] / "data" / "protocol_1.binpb"
PACKAGE = "embomatrix.proto.v1"
POOL = descriptor_pool.DescriptorPool()
for file in descriptor_pb2.FileDescriptorSet.FromString(DESCRIPTION.read_bytes()).file:
    POOL.Add(file)


def narrowed(descriptor, data):
    """The message as a side of version 1 reads and writes it: what it does not know is gone."""
    message = message_factory.GetMessageClass(descriptor).FromString(data)
    message.DiscardUnknownFields()
    return message.SerializeToString()


def method_of(path):
    """What version 1 knows of ``/package.Service/Method``; KeyError for a method that came later."""
    service, _, name = path.lstrip("/").rpartition("/")
    return POOL.FindServiceByName(service).methods_by_name[name]


class NarrowChannel:
    """A channel for the stubs of today, over which only version 1 passes."""

    def __init__(self, channel):
        self._channel = channel

    def __getattr__(self, kind):
        def make(path, request_serializer, response_deserializer, **options):
            # Calls of today's stubs that version 1 has not are never made by a side of version 1.
            with contextlib.suppress(KeyError):
                method = method_of(path)
                return getattr(self._channel, kind)(
                    path,
                    request_serializer=lambda value: narrowed(method.input_type, request_serializer(value)),
                    response_deserializer=lambda data: response_deserializer(
                        narrowed(method.output_type, data)
                    ),
                )
            return None

        return make

    async def close(self):
        await self._channel.close()


@dataclass
class VersionOneManager(FakeManager):
    """A manager of version 1: it takes that version and no range, and does not know that workers leave."""

    async def Register(self, request, context):
        async with translate(context):
            if request.protocol_version != 1:
                raise PreconditionError(
                    f"worker {request.worker_id} speaks protocol {request.protocol_version}, this manager 1: "
                    "install the same release of embomatrix on both"
                )
        return await super().Register(request, context)


@contextlib.asynccontextmanager
async def serving_version_one(servicer, *services):
    """Serve these services' methods of version 1; yields HOST:PORT and the paths that were called."""
    called = []

    class Recorder(grpc.aio.ServerInterceptor):
        async def intercept_service(self, continuation, details):
            called.append(details.method.rpartition("/")[2])
            return await continuation(details)

    server = grpc.aio.server(options=SERVER_OPTIONS, interceptors=[Recorder()])
    for service in services:
        described = POOL.FindServiceByName(f"{PACKAGE}.{service}")
        handlers = {method.name: handler_of(servicer, method) for method in described.methods}
        server.add_generic_rpc_handlers(
            (grpc.method_handlers_generic_handler(described.full_name, handlers),)
        )
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    try:
        yield f"127.0.0.1:{port}", called
    finally:
        await server.stop(None)


def handler_of(servicer, method):
    """Reads and writes messages of today, of which version 1 lets its own fields through."""
    maker = {
        (False, False): grpc.unary_unary_rpc_method_handler,
        (False, True): grpc.unary_stream_rpc_method_handler,
        (True, False): grpc.stream_unary_rpc_method_handler,
        (True, True): grpc.stream_stream_rpc_method_handler,
    }[method.client_streaming, method.server_streaming]
    today = today_of(method.input_type)
    return maker(
        getattr(servicer, method.name),
        request_deserializer=lambda data: today.FromString(narrowed(method.input_type, data)),
        response_serializer=lambda value: narrowed(method.output_type, value.SerializeToString()),
    )


def today_of(descriptor):
    """Today's class of a message of version 1."""
    return message_factory.GetMessageClass(
        descriptor_pool.Default().FindMessageTypeByName(descriptor.full_name)
    )
