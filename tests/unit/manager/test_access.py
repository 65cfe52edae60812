"""Roles of methods, and the life of tokens."""

import json
from dataclasses import dataclass

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from embomatrix.manager.access.credentials import LONGEST_JOIN_S, CredentialBook, hash_of
from embomatrix.manager.access.roles import OPEN, ROLES, may_call, who_may
from embomatrix.proto.v1 import (
    admin_service_pb2,
    rollout_service_pb2,
    scene_service_pb2,
    worker_service_pb2,
)
from embomatrix.rpc.status import InvalidRequestError, NotAllowedError, NotFoundError, NotSignedInError
from embomatrix.rpc.wire.tokens import AccessRole

HOUR = 3600.0
MODULES = (worker_service_pb2, rollout_service_pb2, scene_service_pb2, admin_service_pb2)


def methods():
    return {
        f"/{service.full_name}/{method.name}"
        for module in MODULES
        for service in module.DESCRIPTOR.services_by_name.values()
        for method in service.methods
    }


def test_every_method_has_roles():
    ours = {method for method in ROLES if "/embomatrix." in method}
    assert ours == methods()
    assert {method for method in OPEN if "/embomatrix." in method} <= ours


def test_admins_may_call_listed_methods_and_no_role_may_call_others():
    assert all(may_call(AccessRole.ADMIN, method) for method in ROLES)
    assert not any(may_call(role, "/embomatrix.proto.v1.AdminService/DropEverything") for role in AccessRole)


def test_roles_are_kept_apart():
    service = "/embomatrix.proto.v1."
    allowed = {role: {m.removeprefix(service) for m in methods() if may_call(role, m)} for role in AccessRole}
    assert allowed[AccessRole.JOIN] == {"WorkerService/Register", "RolloutService/GetCapabilities"}
    assert not any(m.startswith(("SceneService", "AdminService")) for m in allowed[AccessRole.WORKER])
    assert {"AdminService/ListWorkers", "RolloutService/GetCapabilities"} <= allowed[AccessRole.VIEWER]
    assert not any(m.startswith(("WorkerService", "SceneService")) for m in allowed[AccessRole.VIEWER])
    assert not any(m.startswith("WorkerService") for m in allowed[AccessRole.TRAINER])
    assert who_may(f"{service}RolloutService/Execute") == "trainer or admin"


def issued(book, role, *, valid_s=0.0, now_s=0.0, label=""):
    credential, token = book.issue(role, valid_s=valid_s, label=label, now_s=now_s)
    book.keep(credential)
    return credential, token


def test_tokens_are_stored_as_hashes_and_survive_a_round_trip():
    book = CredentialBook()
    credential, token = issued(book, AccessRole.TRAINER, label="ann")
    row = credential.row()
    assert token.encode().partition(b".")[2] not in row.payload
    again = CredentialBook([type(credential).of(json.loads(row.payload))])
    assert again.find(token, now_s=1.0) == credential


@pytest.mark.parametrize(
    "wrong", ["", "{id}", "{id}.", ".{secret}", "{id}.secret", "other.{secret}", "{id}.{secret}.x", "ö.ü"]
)
def test_inexact_tokens_are_refused(wrong):
    book = CredentialBook()
    token_id, _, secret = issued(book, AccessRole.TRAINER)[1].partition(".")
    with pytest.raises(NotSignedInError, match="missing or unknown token"):
        book.find(wrong.format(id=token_id, secret=secret), now_s=0.0)


def test_expired_and_revoked_tokens_say_so():
    book = CredentialBook()
    first, token = issued(book, AccessRole.TRAINER, valid_s=HOUR, label="ann's laptop")
    assert book.find(token, now_s=HOUR - 1).role is AccessRole.TRAINER
    with pytest.raises(NotSignedInError, match=r"ann's laptop\) expired: ask the operator"):
        book.find(token, now_s=HOUR)
    second, token = issued(book, AccessRole.VIEWER)
    book.keep(book.revoke(second.token_id, "by the operator"))
    with pytest.raises(NotSignedInError, match=r"was revoked \(by the operator\)"):
        book.find(token, now_s=0.0)
    with pytest.raises(NotFoundError, match="token list"):
        book.revoke("nobody", "")
    assert [info.token_id for info in book.infos(now_s=0.0)] == [first.token_id]
    assert book.infos(now_s=HOUR) == ()


def test_join_token_is_valid_for_one_day_at_most():
    book = CredentialBook()
    assert book.issue(AccessRole.JOIN, valid_s=0.0, label="", now_s=5.0)[0].expires_s == 5.0 + LONGEST_JOIN_S
    for seconds in (LONGEST_JOIN_S + 1, -1.0, float("inf"), float("nan")):
        with pytest.raises(InvalidRequestError):
            book.issue(AccessRole.JOIN, valid_s=seconds, label="", now_s=0.0)


def joined(book, join, worker_id="w1", boot_id="b1", now_s=0.0):
    changed, token = book.redeem(join, worker_id, boot_id, now_s=now_s)
    book.keep(*changed)
    return changed[0], token


def test_join_token_is_exchanged_once_for_a_worker_credential():
    book = CredentialBook()
    join, join_token = issued(book, AccessRole.JOIN)
    own, token = joined(book, join)
    assert book.find(token, now_s=0.0) == own
    assert (own.role, own.worker_id) == (AccessRole.WORKER, "w1")
    used = book.find(join_token, now_s=0.0)
    for worker_id, boot_id in (("w1", "b2"), ("w2", "b1"), ("w1", "b1"), ("w1", "")):
        with pytest.raises(NotSignedInError, match="used already, by worker w1"):
            book.redeem(used, worker_id, boot_id, now_s=0.0)


def test_same_process_may_repeat_a_join():
    book = CredentialBook()
    join, join_token = issued(book, AccessRole.JOIN)
    _, lost = joined(book, join)
    _, token = joined(book, book.find(join_token, now_s=0.0))
    with pytest.raises(NotSignedInError, match="revoked"):
        book.find(lost, now_s=0.0)
    assert book.find(token, now_s=0.0).worker_id == "w1"


def test_worker_name_belongs_to_its_first_machine():
    book = CredentialBook()
    own, _ = joined(book, issued(book, AccessRole.JOIN)[0])
    fleet, _ = issued(book, AccessRole.WORKER)
    with pytest.raises(NotAllowedError, match="another machine joined as worker w1"):
        book.redeem(issued(book, AccessRole.JOIN)[0], "w1", "b9", now_s=0.0)
    with pytest.raises(NotAllowedError, match="belongs to worker w1"):
        book.check_name(own.token_id, own.worker_id, "w2")
    with pytest.raises(NotAllowedError, match="its own credential"):
        book.check_name(fleet.token_id, "", "w1")
    book.check_name(own.token_id, own.worker_id, "w1")
    book.check_name(fleet.token_id, "", "w2")


def test_revoked_worker_must_join_again():
    book = CredentialBook()
    _, token = joined(book, issued(book, AccessRole.JOIN)[0])
    book.keep(book.revoke_worker("w1", "its results were wrong"))
    with pytest.raises(NotSignedInError, match="its results were wrong"):
        book.find(token, now_s=0.0)
    fleet, _ = issued(book, AccessRole.WORKER)
    book.keep(book.revoke_worker("pod-7", "no reason"))
    for name in ("w1", "pod-7"):
        with pytest.raises(NotAllowedError, match="join again"):
            book.check_name(fleet.token_id, "", name)
    again, _ = joined(book, issued(book, AccessRole.JOIN)[0], boot_id="b2")
    book.check_name(again.token_id, "w1", "w1")


@dataclass
class Known:
    role: AccessRole
    expires_s: float
    revoked: bool = False
    worker: str = ""


class TokenMachine(RuleBasedStateMachine):
    """State machine: a token grants access exactly while it is issued, not revoked and not expired."""

    def __init__(self):
        super().__init__()
        self.book = CredentialBook()
        self.now_s = 1000.0
        self.model: dict[str, Known] = {}
        """Issued tokens in order of issue: tokens are random, and drawing from a sorted list would not be repeatable."""

    def valid(self, token):
        known = self.model[token]
        return not known.revoked and not (known.expires_s and self.now_s >= known.expires_s)

    @rule(role=st.sampled_from(AccessRole), valid_s=st.sampled_from([0.0, 10.0, 1000.0]))
    def issue(self, role, valid_s):
        credential, token = self.book.issue(role, valid_s=valid_s, label="", now_s=self.now_s)
        self.book.keep(credential)
        self.model[token] = Known(role, credential.expires_s)

    @rule(seconds=st.sampled_from([1.0, 11.0, 90_000.0]))
    def wait(self, seconds):
        self.now_s += seconds

    @precondition(lambda self: self.model)
    @rule(data=st.data())
    def revoke(self, data):
        token = data.draw(st.sampled_from(list(self.model)))
        self.book.keep(self.book.revoke(token.partition(".")[0], "by the operator"))
        self.model[token].revoked = True

    @precondition(lambda self: any(known.role is AccessRole.JOIN for known in self.model.values()))
    @rule(data=st.data(), worker=st.sampled_from(["w1", "w2"]), boot=st.sampled_from(["b1", "b2", ""]))
    def join(self, data, worker, boot):
        token = data.draw(
            st.sampled_from([t for t, known in self.model.items() if known.role is AccessRole.JOIN])
        )
        if not self.valid(token):
            return
        held = any(
            known.role is AccessRole.WORKER and known.worker == worker and not known.revoked
            for known in self.model.values()
        )
        credential = self.book.find(token, now_s=self.now_s)
        try:
            changed, own = self.book.redeem(credential, worker, boot, now_s=self.now_s)
        except (NotSignedInError, NotAllowedError):
            assert self.model[token].worker or held
            return
        # Every credential is shown right after it was given (see the invariant), so a token to join works once.
        assert not self.model[token].worker
        assert not held
        self.book.keep(*changed)
        self.model[token].worker = worker
        self.model[own] = Known(AccessRole.WORKER, 0.0, worker=worker)

    @invariant()
    def the_book_agrees(self):
        for token, known in self.model.items():
            try:
                found = self.book.find(token, now_s=self.now_s)
            except NotSignedInError:
                assert not self.valid(token)
            else:
                assert self.valid(token)
                assert found.role is known.role
                assert found.secret_hash == hash_of(token.partition(".")[2])


TestTokens = TokenMachine.TestCase
TestTokens.settings = settings(max_examples=30, stateful_step_count=25, deadline=None)
