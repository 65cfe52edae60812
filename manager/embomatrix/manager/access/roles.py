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
_GRANTS: Final = (
    ("WorkerService", frozenset({AccessRole.JOIN, AccessRole.WORKER}), ("Register",)),
    ("WorkerService", _WORKER, ("Session", "Heartbeat", "FetchBundle", "Deregister")),
    ("RolloutService", frozenset(AccessRole), ("GetCapabilities",)),
    ("RolloutService", _TRAINER, ("OpenRun", "AnnounceLookahead", "Execute", "WaitExecution")),
    ("RolloutService", _TRAINER, ("CancelBatch", "Step", "ReportTraining", "CloseRun")),
    ("SceneService", _TRAINER, ("MissingBundles", "PutBundle", "GetBundle")),
    ("AdminService", _VIEWER, ("ListWorkers", "ListRuns", "GetPlan", "GetRun")),
    ("AdminService", _VIEWER, ("ReadEvents", "ExplainRollout")),
    ("AdminService", _ADMIN, ("DrainWorker", "ResumeWorker", "RevokeWorker")),
    ("AdminService", _ADMIN, ("PauseDispatch", "ResumeDispatch")),
    ("AdminService", _ADMIN, ("IssueToken", "ListTokens", "RevokeToken")),
)
"""Roles that may call methods of a service."""
ROLES: Final[Mapping[str, frozenset[AccessRole]]] = {
    f"/{_PACKAGE}.{service}/{method}": roles for service, roles, methods in _GRANTS for method in methods
} | {"/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo": _VIEWER}
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
