"""Acceptance test A18 and what stands behind it: a real manager with TLS and tokens, and everyone who should not get in."""

import asyncio
import contextlib
import json
import os
import socket
import ssl
import stat
import sys
import zlib
from dataclasses import dataclass
from pathlib import Path

import grpc
import httpx
import numpy as np
import pytest
from tests.fakes import simulation
from tests.fakes.commands import background, run
from tests.fakes.guarded import guarded, packed
from tests.fakes.redis_server import RedisServer
from tests.fakes.worker import FakeWorker, completed

from embomatrix.cli.local_cluster import free_port
from embomatrix.manager.app import running
from embomatrix.manager.settings import ManagerSettings
from embomatrix.proto.v1 import admin_service_pb2, rollout_service_pb2, types_pb2, worker_service_pb2
from embomatrix.rpc.client import ClientLimits, ClusterClient
from embomatrix.rpc.convert_session import lease_result_to_proto
from embomatrix.rpc.roles import Role
from embomatrix.rpc.status import (
    ERROR_KEY,
    InvalidRequestError,
    ManagerUnreachableError,
    NotAllowedError,
    NotSignedInError,
    PreconditionError,
    StandbyError,
)
from embomatrix.rpc.token_client import TokenClient
from embomatrix.rpc.trust import Invitation, fetch_ca, fingerprint_of
from embomatrix.rpc.values import Batch, Completed, LeaseRef, LeaseResult, Resources, Rollout
from embomatrix.worker.daemon import Daemon
from embomatrix.worker.membership import membership_of
from embomatrix.worker.settings import WorkerSettings
from embomatrix.world.inflation import bundle_digest

pytestmark = pytest.mark.timeout(120)

KITCHEN, KITCHEN_DATA = packed("a kitchen")
BEDROOM, BEDROOM_DATA = packed("a bedroom")
MIB = 1024 * 1024


def rollouts(count, *, task="t", scene=KITCHEN):
    return tuple(Rollout(f"x{i}", "g", scene, task, (), 0) for i in range(count))


async def until(condition, within_s=10.0):
    async with asyncio.timeout(within_s):
        while not condition():  # noqa: ASYNC110  # the fake's lists have no event to wait for
            await asyncio.sleep(0.01)


@contextlib.asynccontextmanager
async def trainer(at):
    async with ClusterClient(at.address, at.token(Role.TRAINER), ca=at.ca) as client:
        await client.open_run("test", "r1")
        await client.put_bundles({KITCHEN: KITCHEN_DATA, BEDROOM: BEDROOM_DATA})
        yield client


def worker(at, name, **options):
    return FakeWorker(at.address, worker_id=name, ca=at.ca, boot_id=f"boot of {name}", **options)


async def joined(at, name, **options):
    """A worker that joined with a token of its own."""
    return worker(at, name, join_token=await at.issue(Role.JOIN), **options)


@dataclass
class Intruder:
    """Calls with any token, over any channel; the answer is the status it was refused with, and its sentence."""

    address: str
    ca: bytes

    async def call(self, method, request, token="", stream=False):
        # Without our own client's limits: it would not send what the manager has to refuse.
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
                told = any(key == ERROR_KEY for key, _ in error.trailing_metadata() or ())
                return error.code().name, error.details(), told
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
        protocol_version=2,
        resources=types_pb2.Resources(slots=1),
        **fields,
    )


def long_plan(size):
    """One call that is as long as that."""
    return [types_pb2.SkillCall(skill=types_pb2.SKILL_KIND_GO_TO_ROOM, room_name="k" * size)]


async def grpc_cases(at, victim, other):
    """(what is tried, the documented status, what it answered)."""
    viewer, trainer_token = at.token(Role.VIEWER), at.token(Role.TRAINER)
    expired = await at.issue(Role.TRAINER, valid_s=0.05)
    late_join = await at.issue(Role.JOIN, valid_s=0.05)
    revoked = await at.issue(Role.TRAINER)
    async with at.operator() as operator:
        await operator.revoke(revoked.partition(".")[0])
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
            register("victim", join_token=await at.issue(Role.JOIN)),
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
            "a bundle nobody asked for",
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
    """The same for bundles, through the client that a trainer uses; limits are met before all of it is sent."""
    bomb = zlib.compress(bytes(64 * MIB), level=9)
    tries = [
        ("a bomb, 1000 to 1", bomb),
        ("a bundle of 9 MiB", zlib.compress(os.urandom(9 * MIB), level=0)),
        ("noise for a bundle", os.urandom(1000)),
    ]
    async with ClusterClient(at.address, at.token(Role.TRAINER), ca=at.ca) as client:
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
        ("GET figures, a worker's token", 403, "GET", "/api/v1/workers", bearer(Role.WORKER)),
        ("DELETE, no token", 401, "DELETE", "/api/v1/workers/victim", {}),
        ("DELETE, a viewer", 403, "DELETE", "/api/v1/workers/victim", bearer(Role.VIEWER)),
        (
            "DELETE from another origin",
            403,
            "DELETE",
            "/api/v1/workers/victim",
            {**bearer(Role.ADMIN), "origin": "https://evil.example"},
        ),
        (
            "DELETE by a form elsewhere",
            403,
            "DELETE",
            "/api/v1/workers/victim",
            {**bearer(Role.ADMIN), "sec-fetch-site": "cross-site"},
        ),
        ("a foreign name (rebinding)", 400, "GET", "/", {"host": "evil.example"}),
    ]
    context = ssl.create_default_context(cadata=at.ca.decode())
    async with httpx.AsyncClient(base_url=own, verify=context) as http:
        for what, status, method, path, headers in tries:
            answer = await http.request(method, path, headers=headers)
            yield what, str(status), (str(answer.status_code), answer.text, True)
        assert (await http.get("/api/v1/workers", headers=bearer(Role.VIEWER))).status_code == 200
        assert (await http.get("/")).status_code == 200


async def test_a18_everyone_who_should_not_get_in_is_refused_with_the_documented_code_and_a_sentence(
    tmp_path, capsys
):
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
    assert all(told for what, _, (_, _, told) in table if "33 MiB" not in what)


async def test_who_does_not_trust_the_manager_says_nothing_to_it(tmp_path):
    async with guarded(tmp_path / "one") as at, guarded(tmp_path / "two") as elsewhere:
        quick = ClientLimits(call_s=5.0)
        for ca, sentence in ((b"", "pass --ca"), (elsewhere.ca, "not signed by the authority in --ca")):
            async with ClusterClient(at.address, at.token(Role.VIEWER), ca=ca, limits=quick) as client:
                with pytest.raises(ManagerUnreachableError, match=sentence):
                    await client.list_workers()


async def test_an_invitation_leads_to_its_own_manager_and_to_no_other(tmp_path):
    async with guarded(tmp_path / "one") as at, guarded(tmp_path / "two") as elsewhere:
        pinned = fingerprint_of(at.ca.decode())
        assert await fetch_ca(Invitation(at.address, "a.b", pinned)) == at.ca
        with pytest.raises(NotAllowedError, match="not the manager that this invitation is from"):
            await fetch_ca(Invitation(elsewhere.address, "a.b", pinned))
        with pytest.raises(ManagerUnreachableError, match="no manager answers"):
            await fetch_ca(Invitation("127.0.0.1:1", "a.b", pinned))


async def test_a_revoked_worker_ends_at_once_and_its_rollouts_go_elsewhere(tmp_path):
    async with (
        guarded(tmp_path) as at,
        trainer(at) as client,
        await joined(at, "bad", slots=4, stuck={"t"}) as bad,
    ):
        batch = asyncio.create_task(collect(client, 8))
        await until(lambda: len(bad.executed) == 4)
        async with await joined(at, "good", slots=4) as good:
            async with at.operator() as operator:
                await operator.revoke_worker("bad", "its results were wrong")
            results = await batch
            assert len(good.executed) == 8
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await worker(at, "bad", token=bad.token).__aenter__()
        assert caught.value.code() is grpc.StatusCode.UNAUTHENTICATED
        assert "its results were wrong" in caught.value.details()
    assert all(isinstance(result.outcome, Completed) for result in results)


async def collect(client, count):
    return [result async for result in client.execute(Batch("r1", "b1", 1, rollouts(count)), deadline_s=30)]


async def test_a_worker_whose_token_is_revoked_ends_as_well(tmp_path):
    async with guarded(tmp_path) as at:
        fleet = await at.issue(Role.WORKER, label="the lab")
        async with worker(at, "pod-1", token=fleet) as pod:
            async with at.operator() as operator:
                known = {info.token_id: info for info in await operator.listed()}
                assert known[fleet.partition(".")[0]].label == "the lab"
                await operator.revoke(fleet.partition(".")[0])
            await until(lambda: not pod._tasks)


async def test_a_trainer_whose_token_is_revoked_reads_no_further(tmp_path):
    async with guarded(tmp_path) as at, trainer(at) as client, await joined(at, "w1", execute_s=0.05):
        token = await at.issue(Role.TRAINER)
        async with ClusterClient(at.address, token, ca=at.ca) as revoked:
            stream = revoked.execute(Batch("r1", "b1", 1, rollouts(40)), deadline_s=30)
            await anext(stream)
            async with at.operator() as operator:
                await operator.revoke(token.partition(".")[0])
            with pytest.raises(NotSignedInError, match="revoked"):
                async for _ in stream:
                    pass
        # Nothing of the batch is lost: who may read it attaches.
        assert len(await collect(client, 40)) == 40


async def test_tokens_and_credentials_outlive_the_manager_and_what_was_revoked_stays_so(tmp_path):
    async with guarded(tmp_path) as at:
        first = await joined(at, "w1")
        async with first:
            await asyncio.sleep(0.05)
        async with at.operator() as operator:
            await operator.revoke(at.token(Role.VIEWER).partition(".")[0])
    async with guarded(tmp_path) as at:
        async with worker(at, "w1", token=first.token) as again:
            await asyncio.sleep(0.05)
            assert again.session
        with pytest.raises(grpc.aio.AioRpcError) as caught:
            await worker(at, "w2", join_token=first.join_token).__aenter__()
        assert "used already, by worker w1" in caught.value.details()
        async with ClusterClient(at.address, at.token(Role.VIEWER), ca=at.ca) as client:
            with pytest.raises(NotSignedInError, match="revoked"):
                await client.list_workers()
    stored = b"".join(path.read_bytes() for path in tmp_path.glob("state.sqlite*"))
    assert first.token.partition(".")[2].encode() not in stored


async def test_who_takes_a_cluster_over_knows_its_tokens(tmp_path):
    """Two managers on one Redis: what the first handed out and took back holds at the second, which stood by with TLS too."""
    with RedisServer(tmp_path / "redis", free_port()) as redis:
        options = {"state": redis.url, "leader_ttl_s": 1.0}
        standby = free_port()
        over = asyncio.Event()

        async def take_over():
            async with guarded(tmp_path / "data", port=standby, **options) as at:
                for token, outcome in ((given, None), (taken, NotSignedInError)):
                    async with ClusterClient(at.address, token, ca=at.ca) as client:
                        with contextlib.nullcontext() if outcome is None else pytest.raises(outcome):
                            await client.open_run("test", "r1")
                async with worker(at, "w1", token=first.token) as again:
                    assert again.session
                    await asyncio.sleep(0.05)
                over.set()

        async with guarded(tmp_path / "data", **options) as at:
            given, taken = await at.issue(Role.TRAINER), await at.issue(Role.TRAINER)
            async with at.operator() as operator:
                await operator.revoke(taken.partition(".")[0])
            async with await joined(at, "w1") as first:
                await asyncio.sleep(0.05)
            waiting = asyncio.create_task(take_over())
            await until(lambda: stands_by(standby))
            async with ClusterClient(f"127.0.0.1:{standby}", given, ca=at.ca) as client:
                with pytest.raises(StandbyError):
                    await client.list_workers()
        await waiting
        assert over.is_set()


def stands_by(port):
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


async def test_one_shared_token_is_an_admins_for_everybody_beside_the_others(tmp_path):
    async with guarded(tmp_path, token="one-for-all") as at, worker(at, "w1", token="one-for-all") as w1:
        async with ClusterClient(at.address, "one-for-all", ca=at.ca) as client:
            await client.open_run("test", "r1")
            await client.put_bundles({KITCHEN: KITCHEN_DATA})
            assert len(await collect(client, 4)) == 4
            await client.drain_worker("w1")
        assert len(w1.executed) == 4
        async with ClusterClient(at.address, at.token(Role.VIEWER), ca=at.ca) as client:
            assert [found.worker_id for found in await client.list_workers()] == ["w1"]


async def test_an_open_manager_has_no_tokens_to_hand_out(tmp_path):
    settings = ManagerSettings(port=0, http_port=0, data_dir=tmp_path, state="memory:")
    async with running(settings) as at, TokenClient(at.address) as operator:
        with pytest.raises(PreconditionError, match="embomatrix manager init"):
            await operator.issue(Role.TRAINER)


def test_no_port_is_opened_to_others_without_both_tls_and_tokens(tmp_path):
    told = run("manager", "serve", "--host=0.0.0.0", "--port=0", "--http-port=0", f"--data-dir={tmp_path}")
    assert told.status == 2
    assert "refusing to serve on 0.0.0.0 without TLS and tokens" in told.text
    assert f"embomatrix manager init --data-dir {tmp_path} --san HOST" in told.text


def test_what_init_made_is_private_and_never_made_twice(tmp_path):
    told = run("manager", "init", f"--data-dir={tmp_path}", "--san=lab.example", "--san=10.1.2.3")
    assert told.status == 0, told.text
    assert "lab.example" in told.text
    files = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in files}
    assert {name for name, mode in modes.items() if mode != 0o600} == {"ca.pem", "server.pem"}
    assert not any(
        token.strip() in (tmp_path / "access/tokens.json").read_bytes() for token in tokens_of(files)
    )
    again = run("manager", "init", f"--data-dir={tmp_path}")
    assert " made " not in f" {again.text}"
    assert {path: path.read_bytes() for path in files} == files
    wider = run("manager", "init", f"--data-dir={tmp_path}", "--san=other.example")
    assert "other.example, " in wider.text or "other.example" in wider.text
    assert (tmp_path / "access/ca.pem").read_bytes() == files[tmp_path / "access/ca.pem"]
    assert run("manager", "init", f"--data-dir={tmp_path}", "--san=no name").status == 2


def tokens_of(files):
    return [content.partition(b".")[2] for path, content in files.items() if path.parent.name == "tokens"]


def daemon(membership, folder):
    settings = WorkerSettings(cache_dir=folder / "cache", state_dir=folder / "state")
    program = (sys.executable, str(Path(simulation.__file__)))
    return Daemon(
        settings, Resources(1, 1, 500), np.random.default_rng(0), program=program, membership=membership
    )


async def test_a_daemon_joins_once_and_shows_its_credential_from_then_on(tmp_path):
    async with (
        guarded(tmp_path / "manager", stream_grace_s=60.0) as at,
        ClusterClient(at.address, at.token(Role.VIEWER), ca=at.ca) as viewer,
    ):
        invitation = Invitation(at.address, await at.issue(Role.JOIN), fingerprint_of(at.ca.decode()))
        settings = WorkerSettings(join=str(invitation), name="spare", state_dir=tmp_path / "pc" / "state")
        for joining in (True, False):
            membership = await membership_of(settings)
            assert (membership.joining, membership.name) == (joining, "spare")
            working = daemon(membership, tmp_path / "pc")
            serving = asyncio.create_task(working.run())
            async with asyncio.timeout(20):
                while [w.state for w in await viewer.list_workers()] != ["ready"]:  # noqa: ASYNC110
                    await asyncio.sleep(0.05)
            working.stop()
            await serving
            # It said that it leaves: nobody had to wait until it was missed.
            assert [found.state for found in await viewer.list_workers()] == ["lost"]
    [kept] = (tmp_path / "pc" / "state").glob("member-*.json")
    assert stat.S_IMODE(kept.stat().st_mode) == 0o600
    assert str(invitation).partition(".")[2][:20] not in kept.read_text()


@pytest.mark.slow
async def test_a_spare_pc_joins_with_one_string_and_is_known_from_then_on(tmp_path):
    """The commands of an operator and of the PC's owner, each a process of its own."""
    home = tmp_path / "pc"
    async with guarded(tmp_path / "manager") as at:
        ca = at.folder.ca
        options = (f"--manager={at.address}", f"--token=@{at.folder.token(Role.ADMIN)}", f"--ca={ca}")
        told = await asyncio.to_thread(
            run, "manager", "token", "issue", "--role=join", "--label=spare PC", *options
        )
        invitation = next(word for word in told.text.split() if "@" in word)
        worker_run = ("worker", "run", f"--join={invitation}", "--slots=1", "--name=spare")
        folders = (f"--cache-dir={home / 'cache'}", f"--state-dir={home / 'state'}")
        for start in ("first", "second"):
            with background(tmp_path / f"{start}.log", *worker_run, *folders) as command:
                await asyncio.to_thread(command.wait_for, "registered with the manager")
                text = command.text
            assert ("joined the manager" in text) == (start == "first")
        [kept] = (home / "state").glob("member-*.json")
        assert stat.S_IMODE(kept.stat().st_mode) == 0o600
        assert invitation.partition("@")[0] not in kept.read_text()
        assert json.loads(kept.read_text())["name"] == "spare"
        stolen = await asyncio.to_thread(
            run, *worker_run, f"--cache-dir={home / 'c2'}", f"--state-dir={home / 's2'}"
        )
        assert stolen.status == 2
        assert "used already, by worker spare" in stolen.text
        listed = await asyncio.to_thread(run, "manager", "token", "list", *options)
        assert "spare PC" in listed.text
        async with at.operator() as operator:
            await operator.revoke_worker("spare", "sold")
        refused = await asyncio.to_thread(run, *worker_run, *folders)
        assert refused.status == 2
        assert "revoked (sold)" in refused.text
