"""Access rules of the HTTP port, decided from a request's head before its body is read."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse, Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from embomatrix.manager.access.gate import the_token
from embomatrix.manager.settings import LOOPBACK_NAMES, is_loopback
from embomatrix.manager.web.rewards import REWARDS
from embomatrix.rpc.status import NotSignedInError
from embomatrix.rpc.wire.tokens import AccessRole

if TYPE_CHECKING:
    from embomatrix.manager.access.gate import Gate
    from embomatrix.manager.access.protection import Tls

STATIC: Final = "/static/"
"""Prefix of the page's files, which hold nothing about the cluster and need no token."""
OPEN_PATHS: Final = frozenset({"/", "/healthz"})
"""Page and health check, which need no token."""
COMMAND_BYTES: Final = 64 * 1024
"""Bytes of the body of a command; rewards have budgets of their own."""
COMMAND_S: Final = 10.0
"""Seconds from the head of a command to the end of its body."""
READING: Final = frozenset({"GET", "HEAD", "OPTIONS"})
RANKS: Final = (AccessRole.VIEWER, AccessRole.TRAINER, AccessRole.ADMIN)
"""Roles that may send requests. Each may do everything that the roles before it may."""


@dataclass(frozen=True, slots=True)
class HttpRules:
    """``hosts`` are the names that this server answers to; empty: any name."""

    gate: Gate
    hosts: frozenset[str]
    secure: bool = False
    """Served over TLS: pages of plain HTTP are foreign."""

    def refusal(self, method: str, path: str, headers: Headers) -> Response | None:
        """Return the answer to a refused request; None if the request is allowed."""
        host = headers.get("host", "")
        if self.hosts and _name_of(host) not in self.hosts:
            # Prevents DNS rebinding: a foreign page must not reach this server under its own name.
            return PlainTextResponse(
                f"this manager does not answer to the host name {host[:100]!r}: open it under one of its names "
                f"({', '.join(sorted(self.hosts))}), or add this one with `embomatrix manager init --san NAME`",
                400,
            )
        changes = method not in READING
        if changes and self._is_foreign(headers, host):
            return PlainTextResponse(
                "a page of another origin requested a change: open the manager's own dashboard", 403
            )
        if (path in OPEN_PATHS or path.startswith(STATIC)) and not changes:
            return None
        try:
            role = self.gate.caller(the_token(headers.getlist("authorization"))).role
        except NotSignedInError as error:
            sentence = f"{error}; HTTP requests send it as `Authorization: Bearer TOKEN`"
            return PlainTextResponse(sentence, 401, {"www-authenticate": "Bearer"})
        needed = _needed_role(path, changes=changes)
        if role not in RANKS[RANKS.index(needed) :]:
            return PlainTextResponse(f"a token of the role {role} may not do this: it needs {needed}", 403)
        return None

    def _is_foreign(self, headers: Headers, host: str) -> bool:
        """Return True if a page of another origin sent the request. Programs send neither header."""
        origin = headers.get("origin")
        if origin is not None:
            try:
                found = urlsplit(origin)
            except ValueError:
                return True
            return found.netloc.lower() != host.lower() or (self.secure and found.scheme != "https")
        return headers.get("sec-fetch-site", "none") not in ("same-origin", "none")


class Guard:
    """ASGI middleware that applies the rules. WebSockets are refused."""

    def __init__(self, app: ASGIApp, rules: HttpRules) -> None:
        self._app = app
        self._rules = rules

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await send({"type": "websocket.close", "code": 1008})
            return
        refusal = self._rules.refusal(scope["method"], scope["path"], Headers(scope=scope))
        if refusal is None and scope["method"] not in READING and scope["path"] != REWARDS:
            body = await _small_body(receive)
            refusal = body if isinstance(body, Response) else None
            receive = receive if isinstance(body, Response) else _again(body, receive)
        await (refusal or self._app)(scope, receive, send)


async def _small_body(receive: Receive) -> bytes | Response:
    """Return the body of a command, or the answer to one that is too large or does not end."""
    body = bytearray()
    try:
        async with asyncio.timeout(COMMAND_S):
            while True:
                message = await receive()
                body += message.get("body", b"")
                if len(body) > COMMAND_BYTES:
                    return PlainTextResponse(
                        f"the body has more than {COMMAND_BYTES:,} bytes: shorten it", 413
                    )
                if not message.get("more_body", False):
                    return bytes(body)
    except TimeoutError:
        return PlainTextResponse(f"the body did not end within {COMMAND_S:g} s: send it without pauses", 408)


def _again(body: bytes, receive: Receive) -> Receive:
    """Return a ``receive`` that yields the body once more, and then what follows it."""
    waiting: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return waiting.pop() if waiting else await receive()

    return replay


def allowed_hosts(bound: str, tls: Tls | None) -> frozenset[str]:
    """Return the names to answer to: those of the certificate and of loopback; any name if neither applies."""
    if tls is not None:
        return frozenset({*LOOPBACK_NAMES, *(name.lower() for name in tls.names)})
    return frozenset(LOOPBACK_NAMES) if is_loopback(bound) else frozenset()


def _needed_role(path: str, *, changes: bool) -> AccessRole:
    if path == REWARDS:
        return AccessRole.TRAINER
    return AccessRole.ADMIN if changes else AccessRole.VIEWER


def _name_of(host: str) -> str:
    """Return the ``Host`` header without its port; an empty text for one that is no host."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return ""
