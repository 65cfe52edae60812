"""Which roles may call which method: one table, and a test that it names every method of every service."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.rpc.roles import AccessRole

if TYPE_CHECKING:
    from collections.abc import Mapping

_PACKAGE: Final = "embomatrix.proto.v1"
_WORKER: Final = frozenset({AccessRole.WORKER})
_TRAINER: Final = frozenset({AccessRole.TRAINER})
_VIEWER: Final = frozenset({AccessRole.VIEWER, AccessRole.TRAINER})
_ADMIN: Final[frozenset[AccessRole]] = frozenset()

# An admin may call every one of them, and is not repeated.
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
        # Asked before a token may be shown: it tells whom the token would be shown to.
        f"/{_PACKAGE}.RolloutService/GetCapabilities",
        # A joining worker has no token for the header: the request carries the one that it joins with.
        f"/{_PACKAGE}.WorkerService/Register",
    }
)
"""Methods that may be called without a token; one that is shown is checked nevertheless."""


def may_call(role: AccessRole, method: str) -> bool:
    """Whether the role may call ``/package.Service/Method``; nobody may call what the table lacks."""
    roles = ROLES.get(method)
    return roles is not None and (role is AccessRole.ADMIN or role in roles)


def who_may(method: str) -> str:
    """The roles that may call it, in words."""
    others = sorted(ROLES.get(method, _ADMIN) - {AccessRole.ADMIN})
    return " or ".join([*others, AccessRole.ADMIN])
