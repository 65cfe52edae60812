"""Our errors and gRPC status codes: one table, read by the services one way and by the clients the other."""

from __future__ import annotations

import contextlib
import logging
import re
from typing import TYPE_CHECKING, Final

import grpc

from embomatrix.rpc.wire.codec import ConvertError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator, Mapping

logger = logging.getLogger(__name__)

ERROR_KEY: Final = "embomatrix-error"
"""Trailing metadata of a status that our service set: a dead manager is not taken for a busy one."""
LEADER_KEY: Final = "embomatrix-leader"
"""Trailing metadata of a manager that stands by: where the leader is."""


class ClusterError(Exception):
    """What went wrong between a client and the cluster, as one sentence for a person."""


class InvalidRequestError(ClusterError):
    """The request can't be understood: a defect of the sender."""


class NotSignedInError(ClusterError):
    """No token, or one that is not known."""


class NotAllowedError(ClusterError):
    """The token's role may not do this."""


class NotFoundError(ClusterError):
    """The run, batch, bundle or worker is not (or no longer) known. A batch may be submitted again."""


class ConflictError(ClusterError):
    """The same id was used before with other content."""


class PreconditionError(ClusterError):
    """Something must come first: a bundle is missing, or the versions don't fit."""


class OverloadedError(ClusterError):
    """A queue is full: try again later."""


class UnavailableError(ClusterError):
    """The manager can't serve now, or can't be reached; the same call may be tried again."""


class StandbyError(UnavailableError):
    """This manager stands by; ``leader`` is the address (HOST:PORT) of the one that leads."""

    def __init__(self, sentence: str, leader: str = "") -> None:
        super().__init__(sentence)
        self.leader = leader


class ManagerUnreachableError(UnavailableError):
    """Nobody answers at the manager's address."""


class SupersededError(ClusterError):
    """Another session of the same worker id took over, or the epoch is stale: this side must stop."""


class UnknownSessionError(SupersededError):
    """The session was opened by a former manager: register again, and say what is held; this manager may take it up."""


class TrimmedError(ClusterError):
    """The results at this cursor are no longer kept."""


class DeadlineError(ClusterError):
    """No answer within the time given."""


class InternalError(ClusterError):
    """A defect of the other side; its log has the details."""


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
_NAMED: Final[Mapping[str, type[ClusterError]]] = {"unknown-session": UnknownSessionError}
"""Errors that share a status with others, by the value of ``ERROR_KEY`` that tells them apart."""
_NAMES: Final = {error: name for name, error in _NAMED.items()}

_TLS_TROUBLES: Final[Mapping[str, str]] = {
    "WRONG_VERSION_NUMBER": "what answers at {address} does not speak TLS: leave --ca out, or check the port",
    "[Hh]andshake failed": (
        "the certificate at {address} is not signed by the authority in --ca, or has expired: pass the ca.pem of that manager, "
        "or renew it with `embomatrix manager init`"
    ),
    "Hostname Verification": (
        "the certificate at {address} is for other names: call the manager by one of them, or add this one with "
        "`embomatrix manager init --san NAME`"
    ),
    # Only of an attempt to connect: a manager that dies closes its connections too.
    "failed to connect .*Socket closed": (
        "what answers at {address} closed the connection: if it speaks TLS, pass --ca, or set EMBOMATRIX_CA, to the ca.pem "
        "of that manager"
    ),
}
"""What gRPC says of a handshake, as a pattern, and what it means; the first that fits counts."""


@contextlib.asynccontextmanager
async def translate(context: grpc.aio.ServicerContext) -> AsyncIterator[None]:
    """Around a servicer's body: our errors become their status; any other is logged, and ``INTERNAL``."""
    try:
        yield
    except ClusterError as error:
        await _abort(context, _status_of(error), str(error), _metadata(error))
    except ConvertError as error:
        await _abort(context, grpc.StatusCode.INVALID_ARGUMENT, f"malformed message: {error}")
    except grpc.aio.AbortError:
        raise
    except Exception:
        logger.exception("defect while serving a call")
        await _abort(
            context, grpc.StatusCode.INTERNAL, "the manager failed on this call: its log has the details"
        )


async def _abort(
    context: grpc.aio.ServicerContext,
    code: grpc.StatusCode,
    sentence: str,
    metadata: tuple[tuple[str, str], ...] = ((ERROR_KEY, _PLAIN),),
) -> None:
    await context.abort(code, sentence, trailing_metadata=metadata)


def _metadata(error: ClusterError) -> tuple[tuple[str, str], ...]:
    named = ((ERROR_KEY, _NAMES.get(type(error), _PLAIN)),)
    return (*named, (LEADER_KEY, error.leader)) if isinstance(error, StandbyError) else named


def _status_of(error: ClusterError) -> grpc.StatusCode:
    for kind in type(error).__mro__:
        if kind in STATUS:
            return STATUS[kind]
    return grpc.StatusCode.INTERNAL


def cluster_error(error: grpc.aio.AioRpcError, address: str) -> ClusterError:
    """The error of ours for a failed call to ``address`` (HOST:PORT)."""
    code = error.code()
    details = error.details() or ""
    told = {key: str(value) for key, value in error.trailing_metadata() or ()}
    if LEADER_KEY in told:
        return StandbyError(details, told[LEADER_KEY])
    if ERROR_KEY in told:
        return (_NAMED.get(told[ERROR_KEY]) or _ERRORS.get(code, InternalError))(details)
    match code:
        case grpc.StatusCode.UNAVAILABLE if trouble := _tls_trouble(details):
            return ManagerUnreachableError(trouble.format(address=address))
        case grpc.StatusCode.UNAVAILABLE:
            return ManagerUnreachableError(
                f"no manager answers at {address}: start one with `embomatrix manager serve`, "
                "or pass --manager"
            )
        case grpc.StatusCode.DEADLINE_EXCEEDED:
            return DeadlineError(
                f"the manager at {address} did not answer in time: is it overloaded or paused?"
            )
        case grpc.StatusCode.UNIMPLEMENTED:
            return PreconditionError(
                f"what listens at {address} is no manager of this version ({details}): "
                "check --manager and update both"
            )
        case _:
            return _ERRORS.get(code, InternalError)(
                f"the call to {address} failed with {code.name}: {details}"
            )


def _tls_trouble(details: str) -> str:
    """What gRPC's words of a failed handshake mean; empty when it did not come to one."""
    return next((sentence for sign, sentence in _TLS_TROUBLES.items() if re.search(sign, details)), "")


@contextlib.contextmanager
def cluster_errors(address: str) -> Iterator[None]:
    """Around a client's calls: what gRPC raises becomes a ``ClusterError``."""
    try:
        yield
    except grpc.aio.AioRpcError as error:
        raise cluster_error(error, address) from error
    except ConvertError as error:
        raise InternalError(f"the manager at {address} sent a malformed message: {error}") from error
