"""Decoders of the manager and the worker: HTTP, stored rows, settings, credentials, addresses."""

from __future__ import annotations

import contextlib
import functools
import gzip
import json
import math
import os
import random
from collections.abc import Callable, Iterator
from dataclasses import asdict
from typing import Any

from starlette.datastructures import Headers
from tests.fuzz.decoder import Decoder, in_file, mutate_bytes, mutate_json, text_of
from tests.fuzz.wire import PLAN, ROLLOUT
from tests.fuzz.world import use_plan

from embomatrix.manager.access.certificates import (
    life_left,
    make_authority,
    make_server_certificate,
    names_in,
)
from embomatrix.manager.access.credentials import CredentialBook
from embomatrix.manager.access.folder import AccessError, AccessFolder
from embomatrix.manager.access.gate import Gate
from embomatrix.manager.access.protection import protection_of
from embomatrix.manager.commands.app import _settings as manager_settings
from embomatrix.manager.control.reputation import Reputation
from embomatrix.manager.control.schedule.lookahead import LookaheadWindow
from embomatrix.manager.observe.run_archive import SUFFIX, RunArchive
from embomatrix.manager.runtime.serialization import (
    announced_in,
    batch_of,
    batch_row,
    group_and_kind,
    reputation_of,
    reputation_row,
    result_row,
    terms_of,
    terms_payload,
    timed_row,
    window_row,
)
from embomatrix.manager.settings import ManagerSettings
from embomatrix.manager.store.opening import open_store
from embomatrix.manager.store.protocol import BatchRow, NamespaceRow, ResultRow, RunRow, StateError, readable
from embomatrix.manager.store.redis import _row as redis_row
from embomatrix.manager.web.gallery import _parsed as layout_tree
from embomatrix.manager.web.http_rules import HttpRules
from embomatrix.manager.web.parsing import parse_answers
from embomatrix.proto.v1 import admin_service_pb2, types_pb2
from embomatrix.rpc.managers import Managers
from embomatrix.rpc.options import read_config
from embomatrix.rpc.reward_label import RewardLabel
from embomatrix.rpc.status import InvalidRequestError
from embomatrix.rpc.trust import Invitation, read_ca, read_token
from embomatrix.rpc.wire.codec import ConvertError
from embomatrix.rpc.wire.outcome import rollout_result_from_proto
from embomatrix.rpc.wire.rollout import batch_to_proto
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.rpc.wire.values import (
    Batch,
    InfraCode,
    InfraFailure,
    LookaheadEntry,
    Rollout,
    RolloutResult,
    RunTerms,
)
from embomatrix.skills.parse import plan_to_json
from embomatrix.worker.commands.options import parse as worker_settings
from embomatrix.worker.link.membership import Membership, MembershipFile, authority_of
from embomatrix.worker.link.status import WorkerStatus, running_daemons
from embomatrix.world.task import Profile

# HTTP


def _reward_request(body: bytes) -> object:
    answers = parse_answers(body)
    for number, (label, plan) in enumerate(answers):
        if plan is not None:
            use_plan(plan)
            rollout = Rollout(f"r/{number}", "g", label.bundle_digest, label.task_id, plan, label.seed)
            batch_to_proto(Batch("run", "b", 0, (rollout,))).SerializeToString()
    return answers


def _reward_label(data: bytes) -> object:
    label = RewardLabel.parse(text_of(data))
    assert RewardLabel.parse(label.text()) == label
    return label


def _request_head(data: bytes) -> object:
    """Check the head of an HTTP request: method and path in the first line, then its headers."""
    first, *lines = data.split(b"\n")
    method, _, path = first.partition(b" ")
    raw = [tuple(line.partition(b":")[::2]) for line in lines]
    headers = Headers(raw=[(name.lower(), value) for name, value in raw])
    refusals = [
        rules.refusal(method.decode("latin-1"), path.decode("latin-1"), headers) for rules in _rules()
    ]
    for refusal in refusals:
        if refusal is not None:
            bytes(refusal.body).decode()
    return refusals


@functools.cache
def _rules() -> tuple[HttpRules, ...]:
    store = open_store("memory:")
    open_gate, guarded = Gate(store, guarded=False), Gate(store, guarded=True, shared_token="secret")
    hosts = frozenset({"localhost", "127.0.0.1", "manager.lab"})
    return (HttpRules(open_gate, frozenset()), HttpRules(guarded, hosts, secure=True))


def _layout_tree(data: bytes) -> object:
    return json.dumps(layout_tree(data.decode("utf-8", "replace")), ensure_ascii=False).encode()


# Rows of the state store; the first byte of an input selects the kind of row.


def _result(data: bytes) -> object:
    row = timed_row(ResultRow(1, "r-1", data), 0.5)
    group_and_kind(row)
    with contextlib.suppress(ConvertError):  # the trainer's side
        rollout_result_from_proto(types_pb2.RolloutResult.FromString(row.payload))
    return row


def _credential(data: bytes) -> object:
    from embomatrix.manager.access.gate import _credential_of

    book = CredentialBook([_credential_of(NamespaceRow("t", data))])
    return list(book.infos(now_s=1e9))


def _reputation(data: bytes) -> object:
    found = reputation_of(NamespaceRow("w1", data))
    assert reputation_of(reputation_row("w1", found)) == found or found.disputed
    return found


def _redis(data: bytes) -> object:
    with readable("a result"):
        return redis_row(1, data)


ROWS: tuple[Callable[[bytes], object], ...] = (
    lambda data: batch_of(BatchRow("run-1", "b-1", "", data)),
    _result,
    _reputation,
    lambda data: announced_in(NamespaceRow("run-1", data)),
    lambda data: terms_of(RunRow("run-1", "a run", data)),
    _credential,
    _redis,
)


def _stored_row(data: bytes) -> object:
    return ROWS[data[0] % len(ROWS)](data[1:]) if data else None


def _rows() -> list[bytes]:
    failed = RolloutResult("r-1", "g-1", 1, 1, InfraFailure(InfraCode.SLOT_CRASHED, "signal 11"))
    credential, _ = CredentialBook().issue(AccessRole.WORKER, valid_s=60.0, label="a", now_s=1e9)
    row = result_row(failed)
    window = LookaheadWindow(3, (LookaheadEntry(1, "sha256:" + "0" * 64, 2),))
    rows = (
        batch_row(Batch("run-1", "b-1", 0, (ROLLOUT,))).payload,
        row.payload,
        reputation_row("w1", Reputation(taken=3, quarantine="it lied")).payload,
        window_row("run-1", window).payload,
        terms_payload(RunTerms(weight=2.0)),
        credential.row().payload,
        b"3:r-1" + row.payload,
    )
    return [bytes([number]) + payload for number, payload in enumerate(rows)]


def _mutate_row(data: bytes, rng: random.Random) -> bytes:
    is_json = data[1:2] == b"{"
    return data[:1] + mutate_json(data[1:], rng) if is_json else mutate_bytes(data, rng)


def _archive(data: bytes) -> object:
    """Read an archived run. The bytes are its unpacked message, or in gzip format the file itself."""
    packed = data if data[:2] == b"\x1f\x8b" else gzip.compress(data, 1)
    path = in_file(f"runs/run-1{SUFFIX}", packed)
    return RunArchive(path.parent).load("run-1")


def _archived() -> list[bytes]:
    kept = admin_service_pb2.KeptRun()
    kept.summary.run.run_id, kept.summary.series.step_s = "run-1", 1.0
    kept.events.add(sequence=1, at_s=1.0, kind=admin_service_pb2.EVENT_KIND_RUN_OPENED, run_id="run-1")
    kept.training.phase, kept.training.step = "grpo", 2
    phase = kept.training.phases.add(phase="grpo", steps=[1, 2])
    phase.curves.add(name="reward", values=[1.0, math.nan])
    kept.training.plans.add(task_id="t1", instruction="tidy up", text="move 3").steps.add(
        skill="move", ok=True
    )
    plain = kept.SerializeToString()
    return [plain, gzip.compress(plain)]


# Settings and credentials


class _RefusedError(Exception):
    """Exit of a command that printed a sentence."""


@contextlib.contextmanager
def _sentences() -> Iterator[None]:
    """Turn the exit of a command into an exception, without its output. Status 2 means that it printed a sentence."""
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):
        try:
            yield
        except SystemExit as leaving:
            if leaving.code == 2:
                raise _RefusedError from leaving
            raise


def _refuse(sentence: str) -> Any:
    raise _RefusedError(sentence)


def _manager_config(data: bytes) -> ManagerSettings:
    with _sentences():
        return manager_settings({}, read_config(in_file("manager.toml", data), _refuse))


def _worker_config(data: bytes) -> object:
    with _sentences():
        return worker_settings(read_config(in_file("worker.toml", data), _refuse))


MANAGER_TOML = b"""host = "127.0.0.1"
port = 50070
state = "sqlite:state.sqlite"
data_dir = "data"
lease_ttl_s = 30.0
token = "abc"
insecure_bind = false
"""
WORKER_TOML = b"""manager = "127.0.0.1:50070"
name = "pc-1"
slots = 2
labels = {room = "lab"}
[preferences]
"""


def _first_tokens(data: bytes) -> object:
    path = in_file("data/access/tokens.json", data)
    return CredentialBook(AccessFolder(path.parents[1]).first_credentials()).infos(now_s=1e9)


def _certificate(data: bytes) -> object:
    """Read a certificate as clients do, and as a manager does with a key beside it."""
    path = in_file("tls/server.pem", data)
    key, hashes = in_file("tls/server.key", _authority().key), in_file("tls/access/tokens.json", b"[]")
    protection_of(
        ManagerSettings.model_validate(
            {"tls_cert": path, "tls_key": key, "tls_ca": path, "data_dir": hashes.parents[1]}
        )
    )
    return read_ca(path)


@functools.cache
def _authority() -> Any:
    from datetime import UTC, datetime

    return make_authority("fuzz", datetime.now(UTC))


def _server_certificate(data: bytes) -> object:
    """Read the names of a certificate, which `manager init` renews."""
    from datetime import UTC, datetime

    try:
        return names_in(data), life_left(data, datetime.now(UTC))
    finally:
        make_server_certificate(_authority(), ("localhost",), datetime.now(UTC))


def _addresses(data: bytes) -> object:
    """Read an invitation, a list of managers, and a token in a file."""
    text = text_of(data)
    found: list[object] = []
    for read in (Invitation.parse, Managers):
        with contextlib.suppress(InvalidRequestError):
            found.append(read(text))
    found.append(read_token(f"@{in_file('token', data)}"))
    return found


def _membership(data: bytes) -> object:
    folder = in_file("member/x", b"").parent
    file = MembershipFile(folder, "secret")
    file._path.write_bytes(data)
    return file.read()


def _joined_authority(data: bytes) -> object:
    path = in_file("authority/member-x.json", data)
    return authority_of("127.0.0.1:1", path.parent)


def _kept_membership() -> bytes:
    file = MembershipFile(in_file("member/x", b"").parent, "secret")
    file.keep(Membership("127.0.0.1:1", "pc-1", "id.secret", b"-----BEGIN"))
    return file._path.read_bytes()


def _status(data: bytes) -> object:
    path = in_file("state/running/pc-1.json", data)
    return running_daemons(path.parents[1])


def table() -> dict[str, Decoder]:
    """Return the decoders of this module by name."""
    label = RewardLabel("t", "sha256:" + "0" * 64, Profile.PAPER, 3).text()
    answer = "The prompt. " + json.dumps(plan_to_json(PLAN))
    body = json.dumps({"query": [answer], "prompts": ["The prompt."], "labels": [label]}).encode()
    status = json.dumps(asdict(WorkerStatus("pc-1", os.getpid(), started_s=1e12))).encode()
    credential, _ = CredentialBook().issue(AccessRole.JOIN, valid_s=60.0, label="first", now_s=1e9)
    tokens = b"[" + credential.row().payload + b"]"
    return {
        "reward request": Decoder(
            _reward_request,
            (InvalidRequestError,),
            lambda: (body, body.replace(b"[{", b"[ {", 1)),
            frozenset(
                {"manager.web.reward_request:RewardRequest.read", "rpc.reward_label:RewardLabel.parse"}
            ),
            mutate_json,
        ),
        "reward label": Decoder(
            _reward_label,
            (InvalidRequestError,),
            lambda: (label.encode(),),
            frozenset({"rpc.reward_label:RewardLabel.parse"}),
            mutate_json,
        ),
        "request head": Decoder(
            _request_head,
            (),
            lambda: (
                b"POST /api/v1/rewards\nhost:localhost:80\norigin:https://localhost:80\nauthorization:Bearer secret",
                b"GET /api/v1/runs\nhost:[::1]:80\nsec-fetch-site:cross-site\nauthorization:Bearer a\nauthorization:Bearer b",
                b"DELETE /\nhost:[\norigin:null",
            ),
            frozenset(),
            mutate_bytes,
        ),
        "layout tree": Decoder(
            _layout_tree,
            (),
            lambda: (b'{"name": "kitchen_0", "children": []}', b"", b"{"),
            frozenset({"manager.web.gallery:_parsed"}),
            mutate_json,
        ),
        "stored row": Decoder(
            _stored_row,
            (StateError,),
            _rows,
            frozenset(
                f"manager.{name}"
                for name in (
                    "runtime.serialization:batch_of",
                    "runtime.serialization:group_and_kind",
                    "runtime.serialization:reputation_of",
                    "runtime.serialization:announced_in",
                    "runtime.serialization:terms_of",
                    "access.credentials:Credential.of",
                    "access.gate:_credential_of",
                )
            ),
            _mutate_row,
        ),
        "archived run": Decoder(
            _archive,
            (),
            _archived,
            frozenset({"manager.observe.run_archive:RunArchive._message"}),
            mutate_bytes,
        ),
        "manager settings": Decoder(
            _manager_config,
            (_RefusedError,),
            lambda: (MANAGER_TOML,),
            frozenset({"rpc.options:read_config", "manager.commands.app:_settings"}),
            mutate_bytes,
        ),
        "worker settings": Decoder(
            _worker_config,
            (_RefusedError,),
            lambda: (WORKER_TOML,),
            frozenset({"rpc.options:read_config", "worker.commands.options:parse"}),
            mutate_bytes,
        ),
        "first tokens": Decoder(
            _first_tokens,
            (AccessError,),
            lambda: (tokens,),
            frozenset(
                {
                    "manager.access.folder:AccessFolder.first_credentials",
                    "manager.access.credentials:Credential.of",
                }
            ),
            mutate_json,
        ),
        "certificate": Decoder(
            _certificate,
            (AccessError, InvalidRequestError),
            lambda: (_authority().certificate,),
            frozenset(
                {
                    "rpc.trust:fingerprint_of",
                    "manager.access.certificates:names_in",
                    "manager.access.certificates:life_left",
                }
            ),
            mutate_bytes,
        ),
        "addresses": Decoder(
            _addresses,
            (InvalidRequestError,),
            lambda: (
                b"id.secret." + b"0" * 64 + b"@host:1,[::1]:2",
                b"a.b@host:50070",
                b"127.0.0.1:50070, manager.lab:1",
            ),
            frozenset(),
            mutate_bytes,
        ),
        "membership": Decoder(
            _membership,
            (InvalidRequestError,),
            lambda: (_kept_membership(),),
            frozenset({"worker.link.membership:MembershipFile.read"}),
            mutate_json,
        ),
        "authority of a membership": Decoder(
            _joined_authority,
            (),
            lambda: (_kept_membership(),),
            frozenset({"worker.link.membership:authority_of"}),
            mutate_json,
        ),
        "worker status": Decoder(
            _status,
            (),
            lambda: (status,),
            frozenset({"worker.link.status:running_daemons"}),
            mutate_json,
        ),
    }
