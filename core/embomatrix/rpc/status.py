"""Cluster errors and their gRPC status codes, in one table for services and clients."""

import contextlib
import functools
import inspect
import logging
import re
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from typing import Any, Final, TypeVar

import grpc

from embomatrix.host.printable import printable
from embomatrix.rpc.wire.codec import ConvertError

logger = logging.getLogger(__name__)

ServicerT = TypeVar("ServicerT")

ERROR_KEY: Final = "embomatrix-error"
"""Trailing metadata key of every status that our services set. It distinguishes an overloaded manager from a dead one."""
LEADER_KEY: Final = "embomatrix-leader"
"""Trailing metadata key with the leader's address, set by a standby manager."""


class ClusterError(Exception):
    """Error between a client and the cluster. The message is one sentence for the user."""


class InvalidRequestError(ClusterError):
    """Request that cannot be understood: a bug of the sender."""


class NotSignedInError(ClusterError):
    """Missing or unknown token."""


class NotAllowedError(ClusterError):
    """Call that the token's role does not allow."""


class NotFoundError(ClusterError):
    """Unknown or forgotten run, batch, bundle or worker. A batch may be submitted again."""


class ConflictError(ClusterError):
    """Id that was used before with other content."""


class PreconditionError(ClusterError):
    """Missing precondition, such as a bundle or a common protocol version."""


class OverloadedError(ClusterError):
    """Full queue: try again later."""


class UnavailableError(ClusterError):
    """Manager that is unreachable or cannot serve now. The same call may be repeated."""


class StandbyError(UnavailableError):
    """Call to a standby manager; ``leader`` is the HOST:PORT of the leader."""

    def __init__(self, sentence: str, leader: str = "") -> None:
        super().__init__(sentence)
        self.leader = leader


class ManagerUnreachableError(UnavailableError):
    """No answer at the manager's address."""


class SupersededError(ClusterError):
    """Stale session epoch, or a newer session of the same worker id: this side must stop."""


class UnknownSessionError(SupersededError):
    """Session of a former manager: register again and report all leases, which this manager may adopt."""


class SessionLostError(SupersededError):
    """Session whose worker fell silent or whose connection broke for too long: its leases are re-dispatched, register again."""


class TrimmedError(ClusterError):
    """Results that are no longer kept at this cursor."""


class DeadlineError(ClusterError):
    """No answer within the time limit."""


class InternalError(ClusterError):
    """Bug of the other side; its log has the details."""


STATUS: Final[Mapping[type[ClusterError], grpc.StatusCode]] = {
    InvalidRequestError: grpc.StatusCode.INVALID_ARGUMENT,
    NotSignedInError: grpc.StatusCode.UNAUTHENTICATED,
    NotAllowedError: grpc.StatusCode.PERMISSION_DENIED,
    NotFoundError: grpc.StatusCode.NOT_FOUND,
    ConflictError: grpc.StatusCode.ALREADY_EXISTS,
    PreconditionError: grpc.StatusCode.FAILED_PRECONDITION,
    OverloadedError: grpc.StatusCode.RESOURCE_EXHAUSTED,
    UnavailableError: grpc.StatusCode.UNAVAILABLE,
    SupersededError: grpc.StatusCode.ABORTED,
    TrimmedError: grpc.StatusCode.OUT_OF_RANGE,
    DeadlineError: grpc.StatusCode.DEADLINE_EXCEEDED,
    InternalError: grpc.StatusCode.INTERNAL,
}
_ERRORS: Final = {code: error for error, code in STATUS.items()}
_PLAIN: Final = "1"
_NAMED: Final[Mapping[str, type[ClusterError]]] = {
    "unknown-session": UnknownSessionError,
    "session-lost": SessionLostError,
}
"""Errors that share a status with others, by the value of ``ERROR_KEY`` that identifies them."""
_NAMES: Final = {error: name for name, error in _NAMED.items()}

_TROUBLES: Final[Mapping[str, tuple[type[ClusterError], str]]] = {
    # Time does not mend the first two: they are no ManagerUnreachableError, so nobody waits for a manager there.
    "http1.x server": (
        PreconditionError,
        "a web page answers at {address}, and no manager: pass the port that `embomatrix manager serve` prints first, 50070 "
        "unless you chose another",
    ),
    "WRONG_VERSION_NUMBER": (
        PreconditionError,
        "the server at {address} does not speak TLS: leave --ca out, or check the port",
    ),
    "[Hh]andshake failed": (
        ManagerUnreachableError,
        "the certificate at {address} is not signed by the authority in --ca, or has expired: pass the ca.pem of that manager, "
        "or renew it with `embomatrix manager init`",
    ),
    "Hostname Verification": (
        ManagerUnreachableError,
        "the certificate at {address} is for other names: use one of them, or add this one with "
        "`embomatrix manager init --san NAME`",
    ),
    # Only while connecting: a manager that dies closes its connections too.
    "failed to connect .*Socket closed": (
        ManagerUnreachableError,
        "the server at {address} closed the connection: if it speaks TLS, pass --ca, or set EMBOMATRIX_CA, to the ca.pem "
        "of that manager",
    ),
    "address lookup failed|[Nn]ame resolution": (
        ManagerUnreachableError,
        "the host of {address} is unknown: check its spelling and this machine's network, or pass an IP address",
    ),
}
"""Patterns of gRPC's errors while connecting, and their explanations. The first match counts."""


@contextlib.asynccontextmanager
async def translate(context: grpc.aio.ServicerContext) -> AsyncIterator[None]:
    """Turn errors of a servicer's body into gRPC status codes. Unexpected errors are logged and become ``INTERNAL``.

    The body ends there, without a value. ``context.abort`` is not used: its error and gRPC's state refer to each other, so
    the request would stay in memory until a garbage collection.
    """
    try:
        yield
    except grpc.aio.AbortError:
        raise
    except Exception as error:  # noqa: BLE001  # logged unless it is known
        refuse(context, _known(error))


def refuse(context: grpc.aio.ServicerContext, error: ClusterError) -> None:
    """Answer a call with the status of the error, once its servicer returns."""
    context.set_trailing_metadata(_metadata(error))
    context.set_code(_status_of(error))
    context.set_details(str(error))


def translated(servicer: type[ServicerT]) -> type[ServicerT]:
    """Class decorator of a gRPC servicer: errors of its public methods become status codes."""
    for name, method in list(vars(servicer).items()):
        if name[0].isupper():
            setattr(servicer, name, _translated(method))
    return servicer


def _translated(method: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(method)
    async def stream(self: object, request: object, context: grpc.aio.ServicerContext) -> AsyncIterator[Any]:
        async with translate(context), contextlib.aclosing(method(self, request, context)) as messages:
            async for message in messages:
                yield message

    @functools.wraps(method)
    async def call(self: object, request: object, context: grpc.aio.ServicerContext) -> Any:
        async with translate(context):
            return await method(self, request, context)

    return stream if inspect.isasyncgenfunction(method) else call


def _known(error: Exception) -> ClusterError:
    if isinstance(error, ClusterError):
        return error
    if isinstance(error, ConvertError):
        return InvalidRequestError(f"malformed message: {error}")
    logger.exception("unexpected error while serving a call")
    return InternalError("the manager failed on this call: its log has the details")


def _metadata(error: ClusterError) -> tuple[tuple[str, str], ...]:
    named = ((ERROR_KEY, _NAMES.get(type(error), _PLAIN)),)
    return (*named, (LEADER_KEY, error.leader)) if isinstance(error, StandbyError) else named


def _status_of(error: ClusterError) -> grpc.StatusCode:
    statuses = (STATUS[kind] for kind in type(error).__mro__ if kind in STATUS)
    return next(statuses, grpc.StatusCode.INTERNAL)


def cluster_error(error: grpc.aio.AioRpcError, address: str) -> ClusterError:
    """Return the ClusterError of a failed call to ``address`` (HOST:PORT)."""
    code = error.code()
    details = printable(error.details() or "")
    trailers = {key: str(value) for key, value in error.trailing_metadata() or ()}
    if LEADER_KEY in trailers:
        return StandbyError(details, trailers[LEADER_KEY])
    if ERROR_KEY in trailers:
        return (_NAMED.get(trailers[ERROR_KEY]) or _ERRORS.get(code, InternalError))(details)
    match code:
        case grpc.StatusCode.UNAVAILABLE if trouble := _trouble(details):
            kind, sentence = trouble
            return kind(sentence.format(address=address))
        case grpc.StatusCode.UNAVAILABLE:
            return ManagerUnreachableError(
                f"no manager answers at {address}: start one with `embomatrix manager serve`, "
                "or pass --manager"
            )
        case grpc.StatusCode.DEADLINE_EXCEEDED:
            return DeadlineError(
                f"the manager at {address} did not answer in time: check its load, and that it is not paused"
            )
        case grpc.StatusCode.UNIMPLEMENTED:
            return PreconditionError(
                f"the server at {address} is not a manager of this version ({details}): "
                "check --manager and update both"
            )
        case _:
            return _ERRORS.get(code, InternalError)(
                f"the call to {address} failed with {code.name}: {details}"
            )


def _trouble(details: str) -> tuple[type[ClusterError], str] | None:
    """Return the kind and the explanation of a failed connection; None if gRPC's details don't tell."""
    return next((found for sign, found in _TROUBLES.items() if re.search(sign, details)), None)


@contextlib.contextmanager
def cluster_errors(address: str) -> Iterator[None]:
    """Raise gRPC errors of a client's calls as ClusterError."""
    try:
        yield
    except grpc.aio.AioRpcError as error:
        raise cluster_error(error, address) from error
    except ConvertError as error:
        raise InternalError(f"the manager at {address} sent a malformed message: {error}") from error
