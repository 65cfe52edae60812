"""Roles that may call each method. A test checks that the table names every method."""

from collections.abc import Mapping
from typing import Final

from embomatrix.rpc.wire.tokens import AccessRole

_PACKAGE: Final = "embomatrix.proto.v1"
_WORKER: Final = frozenset({AccessRole.WORKER})
_TRAINER: Final = frozenset({AccessRole.TRAINER})
_VIEWER: Final = frozenset({AccessRole.VIEWER, AccessRole.TRAINER})
_ADMIN: Final[frozenset[AccessRole]] = frozenset()

# Admins may call every method and are not listed.
_TABLE: Final[Mapping[str, Mapping[str, frozenset[AccessRole]]]] = {
    f"{_PACKAGE}.WorkerService": {
        "Register": frozenset({AccessRole.JOIN, AccessRole.WORKER}),
        "Session": _WORKER,
        "Heartbeat": _WORKER,
        "FetchBundle": _WORKER,
        "Deregister": _WORKER,
    },
    f"{_PACKAGE}.RolloutService": {
        "GetCapabilities": frozenset(AccessRole),
        "OpenRun": _TRAINER,
        "AnnounceLookahead": _TRAINER,
        "Execute": _TRAINER,
        "WaitExecution": _TRAINER,
        "CancelBatch": _TRAINER,
        "ReportTraining": _TRAINER,
        "CloseRun": _TRAINER,
    },
    f"{_PACKAGE}.SceneService": {
        "MissingBundles": _TRAINER,
        "PutBundle": _TRAINER,
        "GetBundle": _TRAINER,
    },
    f"{_PACKAGE}.AdminService": {
        "ListWorkers": _VIEWER,
        "ListRuns": _VIEWER,
        "GetPlan": _VIEWER,
        "GetRun": _VIEWER,
        "ReadEvents": _VIEWER,
        "ExplainRollout": _VIEWER,
        "DrainWorker": _ADMIN,
        "ResumeWorker": _ADMIN,
        "RevokeWorker": _ADMIN,
        "PauseDispatch": _ADMIN,
        "ResumeDispatch": _ADMIN,
        "IssueToken": _ADMIN,
        "ListTokens": _ADMIN,
        "RevokeToken": _ADMIN,
    },
    "grpc.reflection.v1alpha.ServerReflection": {"ServerReflectionInfo": _VIEWER},
}
ROLES: Final[Mapping[str, frozenset[AccessRole]]] = {
    f"/{service}/{method}": roles for service, methods in _TABLE.items() for method, roles in methods.items()
}
OPEN: Final = frozenset(
    {
        "/grpc.health.v1.Health/Check",
        "/grpc.health.v1.Health/Watch",
        # Called before a client shows its token, to verify the manager.
        f"/{_PACKAGE}.RolloutService/GetCapabilities",
        # A joining worker sends its join token in the request.
        f"/{_PACKAGE}.WorkerService/Register",
    }
)
"""Methods that need no token. A token that is sent is checked nevertheless."""


def may_call(role: AccessRole, method: str) -> bool:
    """Return True if the role may call ``/package.Service/Method``. Unlisted methods are forbidden."""
    roles = ROLES.get(method)
    return roles is not None and (role is AccessRole.ADMIN or role in roles)


def who_may(method: str) -> str:
    """Return the roles that may call the method, for messages."""
    others = sorted(ROLES.get(method, _ADMIN) - {AccessRole.ADMIN})
    return " or ".join([*others, AccessRole.ADMIN])
