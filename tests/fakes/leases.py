"""Lease messages for fakes of the manager."""

from embomatrix.proto.v1 import worker_service_pb2
from embomatrix.rpc.wire.session import write_lease


def lease_to_proto(lease):
    message = worker_service_pb2.Lease()
    write_lease(lease, message)
    return message
