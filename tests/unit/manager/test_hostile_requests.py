"""Requests that a proxy, a browser or a log reader would understand differently from the manager."""

import logging
import stat

import pytest
from starlette.datastructures import Headers
from starlette.responses import PlainTextResponse

from embomatrix.host.printable import printable
from embomatrix.manager.access.gate import Gate, the_token
from embomatrix.manager.store.sqlite import SqliteStore
from embomatrix.manager.web.http_rules import COMMAND_BYTES, Guard, HttpRules
from embomatrix.proto.v1 import rollout_service_pb2
from embomatrix.rpc.logs import HumanFormatter
from embomatrix.rpc.status import NotSignedInError
from embomatrix.rpc.wire.bounds import check
from embomatrix.rpc.wire.codec import ConvertError


def test_call_with_two_tokens_is_refused_whatever_their_order():
    assert the_token([]) == ""
    assert the_token(["Bearer one"]) == "one"
    for headers in (["Bearer one", "Bearer two"], ["Bearer two", "Bearer one"], ["Bearer one", "Bearer one"]):
        with pytest.raises(NotSignedInError, match="found 2 authorization headers: send one"):
            the_token(headers)


def rules(*, secure):
    return HttpRules(Gate(None, guarded=False), frozenset(), secure=secure)


def posted(origin, **headers):
    return Headers({"host": "manager.example", "origin": origin, **headers})


def test_plain_page_may_not_change_a_manager_behind_tls():
    plain, own = posted("http://manager.example"), posted("https://manager.example")
    assert rules(secure=True).refusal("POST", "/api/v1/rewards", plain).status_code == 403
    assert rules(secure=True).refusal("POST", "/api/v1/rewards", own) is None
    assert rules(secure=False).refusal("POST", "/api/v1/rewards", plain) is None


def test_host_and_origin_that_are_no_addresses_are_refused():
    guarded = HttpRules(Gate(None, guarded=True, shared_token="secret"), frozenset({"localhost"}))
    for host in ("[", "[::1", "a]b", "//["):
        assert guarded.refusal("GET", "/", Headers({"host": host})).status_code == 400
    for origin in ("http://[", "https://[::1", "//]"):
        assert rules(secure=False).refusal("POST", "/api/v1/rewards", posted(origin)).status_code == 403


def test_two_authorization_headers_over_http_are_refused():
    raw = [(b"host", b"manager.example"), (b"authorization", b"Bearer a"), (b"authorization", b"Bearer b")]
    refusal = rules(secure=False).refusal("GET", "/api/v1/runs", Headers(raw=raw))
    assert refusal.status_code == 401


async def test_state_file_is_readable_by_its_owner_only(tmp_path):
    path = tmp_path / "data" / "state.sqlite"
    path.parent.mkdir()
    path.touch(0o644)
    store = SqliteStore(path)
    await store.workers()
    files = list(path.parent.iterdir())
    assert {file.name for file in files} >= {"state.sqlite", "state.sqlite-wal", "state.sqlite-shm"}
    for file in files:
        assert stat.S_IMODE(file.stat().st_mode) == 0o600, file.name
    await store.close()


@pytest.mark.parametrize("name", ["a\nlevel=info", "a\x1b[2J", "a\u202eb", "a\x9b31m"])
def test_name_with_control_characters_is_refused(name):
    with pytest.raises(ConvertError, match=r"name: found .* without control characters"):
        check(rollout_service_pb2.OpenRunRequest(name=name))


def test_log_line_stays_one_line_and_drives_no_terminal():
    record = logging.LogRecord(
        "a", logging.INFO, "", 0, "run opened name=%s", ("x\n2026 ERROR forged\x1b[31m",), None
    )
    line = HumanFormatter().format(record)
    assert "\n" not in line
    assert "\x1b" not in line
    assert r"x\n2026 ERROR forged\u001b[31m" in line
    assert printable("café ✓") == "café ✓"


async def answered(body, *, path="/api/v1/workers/w1/drain"):
    """Return the status of a command with this body, and the body that the application read."""
    read, sent, waiting = [], [], [body[:100], body[100:]]

    async def application(scope, receive, send):
        read.append((await receive())["body"])
        await PlainTextResponse("done")(scope, receive, send)

    async def receive():
        return {"type": "http.request", "body": waiting.pop(0), "more_body": bool(waiting)}

    async def send(message):
        sent.append(message)

    guard = Guard(application, rules(secure=False))
    scope = {"type": "http", "method": "POST", "path": path, "headers": []}
    await guard(scope, receive, send)
    return sent[0]["status"], read


async def test_body_of_a_command_is_bounded_and_passed_on_unchanged():
    body = bytes(range(256)) * 200
    assert await answered(body) == (200, [body])
    assert await answered(b"x" * (COMMAND_BYTES + 1)) == (413, [])
