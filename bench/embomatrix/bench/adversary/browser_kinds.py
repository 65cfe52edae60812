"""Kinds of requests that a hostile client sends to the HTTP port."""

import json
from collections.abc import Callable, Sequence
from typing import Final

from embomatrix.bench.adversary.kinds import AttackerRole, Knowledge, hostile
from embomatrix.bench.adversary.messages import MessageMaker

REWARDS: Final = "/api/v1/rewards"
NESTED: Final = 2_000
"""Depth of a nested answer: deep enough to hurt a parser that is not linear, small enough for many of them."""
BODY_BYTES: Final = 60_000_000
"""Announced length of a body that never comes."""

RequestOf = Callable[[Knowledge, MessageMaker], bytes]


def _http_kind(name: str, weight: float = 1.0) -> Callable[[RequestOf], RequestOf]:
    def enter(request_of: RequestOf) -> RequestOf:
        @hostile(name, AttackerRole.BROWSER, weight=weight)
        def make(known: Knowledge, maker: MessageMaker) -> Sequence[bytes]:
            return [request_of(known, maker)]

        return request_of

    return enter


def _post(known: Knowledge, path: str, body: bytes, *headers: str) -> bytes:
    lines = (
        f"POST {path} HTTP/1.1",
        f"Host: {known.host}",
        f"Authorization: Bearer {known.token}",
        f"Content-Length: {len(body)}",
        "Connection: close",
        *headers,
    )
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + body


def _get(known: Knowledge, path: str, *headers: str) -> bytes:
    lines = (f"GET {path} HTTP/1.1", f"Host: {known.host}", "Connection: close", *headers)
    return "\r\n".join(lines).encode("latin-1", "replace") + b"\r\n\r\n"


def _rewards(known: Knowledge, answers: Sequence[str], labels: Sequence[str]) -> bytes:
    body = {"query": list(answers), "prompts": [""] * len(answers), "labels": list(labels)}
    return _post(known, REWARDS, json.dumps(body).encode())


@_http_kind("answer of nested brackets")
def _nested(known: Knowledge, maker: MessageMaker) -> bytes:
    opened = maker.rng.choice(("[", "{", '{"a":', '[{"skill":'))
    return _rewards(known, [opened * NESTED], ["{}"])


@_http_kind("answer with numbers of 4,000 digits")
def _digits(known: Knowledge, maker: MessageMaker) -> bytes:
    del maker
    return _rewards(known, ['[{"skill": "move", "object": ' + "9" * 4_000 + "}]"], ["{}"])


@_http_kind("labels that are none")
def _labels(known: Knowledge, maker: MessageMaker) -> bytes:
    return _rewards(known, ["[]"], [maker.text()])


@_http_kind("body that is no JSON")
def _no_json(known: Knowledge, maker: MessageMaker) -> bytes:
    return _post(known, REWARDS, maker.rng.randbytes(200))


@_http_kind("body that never comes")
def _half_open(known: Knowledge, maker: MessageMaker) -> bytes:
    del maker
    return _post(known, REWARDS, b"").replace(b"Content-Length: 0", f"Content-Length: {BODY_BYTES}".encode())


@_http_kind("two authorization headers")
def _two_tokens(known: Knowledge, maker: MessageMaker) -> bytes:
    headers = ["Authorization: Bearer wrong", f"Authorization: Bearer {known.token}"]
    maker.rng.shuffle(headers)
    return _get(known, "/api/v1/snapshot", *headers)


@_http_kind("forged origin")
def _origin(known: Knowledge, maker: MessageMaker) -> bytes:
    origin = maker.rng.choice(("https://evil.example", "null", "http://127.0.0.1.evil.example", maker.text()))
    clean = origin.replace("\n", "").replace("\x00", "")
    return _post(known, "/api/v1/dispatch/pause", b"{}", f"Origin: {clean}", "Sec-Fetch-Site: cross-site")


@_http_kind("forged host")
def _host(known: Knowledge, maker: MessageMaker) -> bytes:
    del maker
    return _get(known, "/api/v1/snapshot").replace(known.host.encode(), b"evil.example")


@_http_kind("path outside the folder")
def _path(known: Knowledge, maker: MessageMaker) -> bytes:
    path = maker.rng.choice(
        ("/../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/static/..%5c..%5cx", "/api/v1/runs/%00")
    )
    return _get(known, path, f"Authorization: Bearer {known.token}")


@_http_kind("header of 100 kB")
def _long_header(known: Knowledge, maker: MessageMaker) -> bytes:
    del maker
    return _get(known, "/", "X-Long: " + "x" * 100_000)


@_http_kind("request line that is none")
def _no_request(known: Knowledge, maker: MessageMaker) -> bytes:
    del known
    return maker.rng.randbytes(64) + b"\r\n\r\n"


@_http_kind("chunks of impossible sizes")
def _chunked(known: Knowledge, maker: MessageMaker) -> bytes:
    size = maker.rng.choice((b"ffffffffffffffff", b"-1", b"zz", b""))
    head = _post(known, REWARDS, b"").replace(b"Content-Length: 0", b"Transfer-Encoding: chunked")
    return head + size + b"\r\nabc\r\n0\r\n\r\n"


@_http_kind("query numbers out of range")
def _numbers(known: Knowledge, maker: MessageMaker) -> bytes:
    path = f"/api/v1/snapshot?offset={maker.count()}&limit={maker.number()}&state=%1b%5b2J"
    return _get(known, path, f"Authorization: Bearer {known.token}")
