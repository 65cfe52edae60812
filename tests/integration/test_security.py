"""Acceptance test A18: a real manager with TLS and tokens refuses unauthorized calls."""

import asyncio
import os
import ssl
import zlib
from dataclasses import dataclass

import grpc
import httpx
import pytest
from tests.fakes.guarded import (
    BEDROOM,
    KITCHEN,
    guarded,
    joined,
    rollouts,
    trainer,
    until,
)
from tests.fakes.worker import completed

from embomatrix.proto.v1 import admin_service_pb2, rollout_service_pb2, types_pb2, worker_service_pb2
from embomatrix.rpc.client import ClientLimits, ClusterClient
from embomatrix.rpc.status import (
    ERROR_KEY,
    InvalidRequestError,
    ManagerUnreachableError,
    NotAllowedError,
)
from embomatrix.rpc.trust import Invitation, fetch_ca, fingerprint_of
from embomatrix.rpc.versions import PROTOCOL_VERSION
from embomatrix.rpc.wire.leases import LeaseRef, LeaseResult
from embomatrix.rpc.wire.session import lease_result_to_proto
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.rpc.wire.values import Batch, Completed
from embomatrix.world.inflation import bundle_digest

pytestmark = pytest.mark.timeout(120)

MIB = 1024 * 1024


@dataclass
class Intruder:
    """Caller with any token over any channel; returns the refusal's status and message."""

    address: str
    ca: bytes

    async def call(self, method, request, token="", stream=False):
        # Without our client's limits, which would refuse these requests before the manager can.
        trusted = grpc.ssl_channel_credentials(self.ca)
        metadata = (("authorization", f"Bearer {token}"),) if token else ()
        options = (("grpc.max_send_message_length", -1),)
        async with grpc.aio.secure_channel(self.address, trusted, options) as channel:
            service, _, name = method.rpartition(".")
            path = f"/embomatrix.proto.v1.{service}/{name}"
            kind = channel.unary_stream if stream else channel.unary_unary
            made = kind(path, request_serializer=type(request).SerializeToString, response_deserializer=bytes)
            try:
                if stream:
                    answers = [answer async for answer in made(request, timeout=10, metadata=metadata)]
                else:
                    answers = [await made(request, timeout=10, metadata=metadata)]
            except grpc.aio.AioRpcError as error:
                named = any(key == ERROR_KEY for key, _ in error.trailing_metadata() or ())
                return error.code().name, error.details(), named
        return "OK", answers, True


def execute(*plans, task="t"):
    return rollout_service_pb2.ExecuteRequest(
        run_id="r1",
        batch_id="intruder",
        rollouts=[
            types_pb2.Rollout(
                rollout_id=f"i{n}", group_id="g", bundle_digest=KITCHEN, task_id=task, plan=plan
            )
            for n, plan in enumerate(plans)
        ],
    )


def register(name, **fields):
    return worker_service_pb2.RegisterRequest(
        worker_id=name,
        boot_id="intruder",
        protocol_version=PROTOCOL_VERSION,
        resources=types_pb2.Resources(slots=1),
        **fields,
    )


def long_plan(size):
    """Return a plan whose one call has this length."""
    return [types_pb2.SkillCall(skill=types_pb2.SKILL_KIND_GO_TO_ROOM, room_name="k" * size)]


async def grpc_cases(at, victim, other):
    """Return (attempt, documented status, response) for gRPC calls."""
    viewer, trainer_token = at.token(AccessRole.VIEWER), at.token(AccessRole.TRAINER)
    expired = await at.issue(AccessRole.TRAINER, valid_s=0.05)
    late_join = await at.issue(AccessRole.JOIN, valid_s=0.05)
    revoked = await at.issue(AccessRole.TRAINER)
    async with at.operator() as operator:
        await operator.revoke_token(revoked.partition(".")[0])
    await asyncio.sleep(0.06)
    session = {"session_id": victim.session[0], "session_epoch": victim.session[1]}
    state = worker_service_pb2.WorkerState()
    fetch = worker_service_pb2.FetchBundleRequest
    forged = worker_service_pb2.SessionRequest(
        **session,
        state=state,
        results=[lease_result_to_proto(LeaseResult(LeaseRef("l1", 1), completed("victim")))],
    )
    drain = admin_service_pb2.DrainWorkerRequest(worker_id="victim")
    token_for_all = admin_service_pb2.IssueTokenRequest(role=admin_service_pb2.ROLE_ADMIN)
    intruder = Intruder(at.address, at.ca)
    tries = [
        ("no token", "UNAUTHENTICATED", "RolloutService.Execute", execute([]), "", True),
        ("an invented token", "UNAUTHENTICATED", "RolloutService.Execute", execute([]), "abc.def", True),
        ("an expired token", "UNAUTHENTICATED", "RolloutService.Execute", execute([]), expired, True),
        ("a revoked token", "UNAUTHENTICATED", "RolloutService.Execute", execute([]), revoked, True),
        ("a viewer submits", "PERMISSION_DENIED", "RolloutService.Execute", execute([]), viewer, True),
        ("a worker submits", "PERMISSION_DENIED", "RolloutService.Execute", execute([]), other.token, True),
        ("a trainer drains", "PERMISSION_DENIED", "AdminService.DrainWorker", drain, trainer_token, False),
        ("a viewer issues", "PERMISSION_DENIED", "AdminService.IssueToken", token_for_all, viewer, False),
        (
            "a trainer registers",
            "PERMISSION_DENIED",
            "WorkerService.Register",
            register("w9"),
            trainer_token,
            False,
        ),
        ("no join token", "UNAUTHENTICATED", "WorkerService.Register", register("w9"), "", False),
        (
            "a join token, replayed",
            "UNAUTHENTICATED",
            "WorkerService.Register",
            register("w9", join_token=victim.join_token),
            "",
            False,
        ),
        (
            "an expired join token",
            "UNAUTHENTICATED",
            "WorkerService.Register",
            register("w9", join_token=late_join),
            "",
            False,
        ),
        (
            "another's name",
            "PERMISSION_DENIED",
            "WorkerService.Register",
            register("victim"),
            other.token,
            False,
        ),
        (
            "another's name, joining",
            "PERMISSION_DENIED",
            "WorkerService.Register",
            register("victim", join_token=await at.issue(AccessRole.JOIN)),
            "",
            False,
        ),
        (
            "a newer protocol",
            "FAILED_PRECONDITION",
            "WorkerService.Register",
            worker_service_pb2.RegisterRequest(worker_id="w9", protocol_version=9, protocol_low=8),
            other.token,
            False,
        ),
        (
            "another's heartbeat",
            "PERMISSION_DENIED",
            "WorkerService.Heartbeat",
            worker_service_pb2.HeartbeatRequest(**session),
            other.token,
            False,
        ),
        ("another's results", "PERMISSION_DENIED", "WorkerService.Session", forged, other.token, True),
        (
            "another's leave",
            "PERMISSION_DENIED",
            "WorkerService.Deregister",
            worker_service_pb2.DeregisterRequest(**session),
            other.token,
            False,
        ),
        (
            "a bundle by another's session",
            "PERMISSION_DENIED",
            "WorkerService.FetchBundle",
            fetch(session_id=session["session_id"], bundle_digest=KITCHEN),
            other.token,
            True,
        ),
        (
            "an unrequested bundle",
            "PERMISSION_DENIED",
            "WorkerService.FetchBundle",
            fetch(session_id=other.session[0], bundle_digest=BEDROOM),
            other.token,
            True,
        ),
        (
            "a plan of 1 MB",
            "INVALID_ARGUMENT",
            "RolloutService.Execute",
            execute(long_plan(MIB)),
            trainer_token,
            True,
        ),
        (
            "a plan of 65 steps",
            "INVALID_ARGUMENT",
            "RolloutService.Execute",
            execute(long_plan(4) * 65),
            trainer_token,
            True,
        ),
        (
            "a message of 33 MiB",
            "RESOURCE_EXHAUSTED",
            "RolloutService.Execute",
            execute(long_plan(33 * MIB)),
            trainer_token,
            True,
        ),
    ]
    for what, expected, method, request, token, stream in tries:
        yield what, expected, await intruder.call(method, request, token, stream)


async def bundle_cases(at):
    """Return the same for bundles through a trainer's client; limits apply before the whole bundle is sent."""
    bomb = zlib.compress(bytes(64 * MIB), level=9)
    tries = [
        ("a bomb, 1000 to 1", bomb),
        ("a bundle of 9 MiB", zlib.compress(os.urandom(9 * MIB), level=0)),
        ("noise for a bundle", os.urandom(1000)),
    ]
    async with ClusterClient(at.address, at.token(AccessRole.TRAINER), ca=at.ca) as client:
        for what, data in tries:
            with pytest.raises(InvalidRequestError) as caught:
                await client.put_bundles({bundle_digest(data): data})
            yield what, "INVALID_ARGUMENT", ("INVALID_ARGUMENT", str(caught.value), True)
        with pytest.raises(InvalidRequestError) as caught:
            await client.put_bundles({"../../etc/passwd": b"x"})
        yield "a digest that is a path", "INVALID_ARGUMENT", ("INVALID_ARGUMENT", str(caught.value), True)


async def http_cases(at):
    def bearer(role):
        return {"authorization": f"Bearer {at.token(role)}"}

    own = at.page.rstrip("/")
    tries = [
        ("GET figures, no token", 401, "GET", "/api/v1/workers", {}),
        ("GET metrics, no token", 401, "GET", "/metrics", {}),
        ("GET figures, a worker's token", 403, "GET", "/api/v1/workers", bearer(AccessRole.WORKER)),
        ("DELETE, no token", 401, "DELETE", "/api/v1/workers/victim", {}),
        ("DELETE, a viewer", 403, "DELETE", "/api/v1/workers/victim", bearer(AccessRole.VIEWER)),
        (
            "DELETE from another origin",
            403,
            "DELETE",
            "/api/v1/workers/victim",
            {**bearer(AccessRole.ADMIN), "origin": "https://evil.example"},
        ),
        (
            "DELETE by a form elsewhere",
            403,
            "DELETE",
            "/api/v1/workers/victim",
            {**bearer(AccessRole.ADMIN), "sec-fetch-site": "cross-site"},
        ),
        ("a foreign name (rebinding)", 400, "GET", "/", {"host": "evil.example"}),
    ]
    context = ssl.create_default_context(cadata=at.ca.decode())
    async with httpx.AsyncClient(base_url=own, verify=context) as http:
        for what, status, method, path, headers in tries:
            answer = await http.request(method, path, headers=headers)
            yield what, str(status), (str(answer.status_code), answer.text, True)
        assert (await http.get("/api/v1/workers", headers=bearer(AccessRole.VIEWER))).status_code == 200
        assert (await http.get("/")).status_code == 200


async def test_a18_unauthorized_calls_are_refused_with_the_documented_code(tmp_path, capsys):
    table = []
    async with (
        guarded(tmp_path) as at,
        trainer(at) as client,
        await joined(at, "victim", stuck={"stay"}) as victim,
        await joined(at, "other") as other,
    ):
        await until(lambda: victim.session and other.session)
        async for row in grpc_cases(at, victim, other):
            table.append(row)
        async for row in bundle_cases(at):
            table.append(row)
        async for row in http_cases(at):
            table.append(row)
        assert (victim.executed, other.executed) == ([], [])
        assert not victim.fetched
        assert not other.fetched
        results = [
            result async for result in client.execute(Batch("r1", "b1", 1, rollouts(4)), deadline_s=20)
        ]
        assert all(isinstance(result.outcome, Completed) for result in results)
    with capsys.disabled():
        print(f"\nA18: {len(table)} intrusions, 0 executed")
        for what, _, (status, sentence, _) in table:
            print(f"  {what:32} {status:20} {' '.join(str(sentence).split())[:100]}")
    assert [(what, status) for what, _, (status, _, _) in table] == [
        (what, expected) for what, expected, _ in table
    ]
    assert all(named for what, _, (_, _, named) in table if "33 MiB" not in what)


async def test_client_without_trust_sends_no_token(tmp_path):
    async with guarded(tmp_path / "one") as at, guarded(tmp_path / "two") as elsewhere:
        quick = ClientLimits(call_s=5.0)
        for ca, sentence in ((b"", "pass --ca"), (elsewhere.ca, "not signed by the authority in --ca")):
            async with ClusterClient(at.address, at.token(AccessRole.VIEWER), ca=ca, limits=quick) as client:
                with pytest.raises(ManagerUnreachableError, match=sentence):
                    await client.list_workers()


async def test_invitation_is_accepted_by_its_own_manager_only(tmp_path):
    async with guarded(tmp_path / "one") as at, guarded(tmp_path / "two") as elsewhere:
        pinned = fingerprint_of(at.ca.decode())
        assert await fetch_ca(Invitation(at.address, "a.b", pinned)) == at.ca
        with pytest.raises(NotAllowedError, match="not the manager of this invitation"):
            await fetch_ca(Invitation(elsewhere.address, "a.b", pinned))
        with pytest.raises(ManagerUnreachableError, match="no manager answers"):
            await fetch_ca(Invitation("127.0.0.1:1", "a.b", pinned))
