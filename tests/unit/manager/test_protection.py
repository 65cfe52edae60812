"""Required protection at start, and the files of `manager init`."""

import time
from datetime import UTC, datetime, timedelta

import pytest

from embomatrix.manager.access.certificates import (
    life_left,
    make_authority,
    make_server_certificate,
    names_in,
)
from embomatrix.manager.access.folder import AccessError, AccessFolder, hand_out_to, prepare
from embomatrix.manager.access.gate import Gate
from embomatrix.manager.access.protection import protection_of
from embomatrix.manager.settings import ManagerSettings
from embomatrix.manager.store.opening import open_store
from embomatrix.manager.store.protocol import Candidate
from embomatrix.rpc.status import InvalidRequestError
from embomatrix.rpc.trust import Invitation, fingerprint_of, read_ca, read_token
from embomatrix.rpc.wire.tokens import AccessRole

NOW = datetime(2026, 11, 1, tzinfo=UTC)


def settings(data_dir, **changes):
    return ManagerSettings(data_dir=data_dir, **changes)


@pytest.mark.parametrize("host", ["127.0.0.1", "::1", "localhost"])
def test_loopback_needs_no_protection(tmp_path, host):
    found = protection_of(settings(tmp_path, host=host))
    assert (found.tls, found.guarded) == (None, False)


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.5", "manager", "::"])
@pytest.mark.parametrize("where", ["host", "http_host"])
def test_beyond_loopback_both_are_needed(tmp_path, host, where):
    for token, lacking in (("", "without TLS and tokens"), ("secret", "without TLS:")):
        with pytest.raises(AccessError, match=lacking):
            protection_of(settings(tmp_path, token=token, **{where: host}))
    assert not protection_of(settings(tmp_path, insecure_bind=True, **{where: host})).guarded
    prepare(tmp_path, sans=())
    found = protection_of(settings(tmp_path, **{where: host}))
    assert found.guarded
    assert "127.0.0.1" in found.tls.names


def test_own_certificates_need_tokens_too(tmp_path):
    prepare(tmp_path / "own", sans=("lab.example",))
    folder = AccessFolder(tmp_path / "own")
    own = {"tls_cert": folder.server, "tls_key": folder.server_key, "tls_ca": folder.ca}
    with pytest.raises(AccessError, match="without tokens"):
        protection_of(settings(tmp_path / "data", host="0.0.0.0", **own))
    found = protection_of(settings(tmp_path / "data", host="0.0.0.0", token="secret", **own))
    assert found.tls.authority == folder.ca.read_bytes()


def test_key_of_another_certificate_is_refused(tmp_path):
    for name in ("one", "two"):
        prepare(tmp_path / name, sans=())
    one, two = AccessFolder(tmp_path / "one"), AccessFolder(tmp_path / "two")
    with pytest.raises(AccessError, match="is not the key of the certificate"):
        protection_of(settings(tmp_path, tls_cert=one.server, tls_key=two.server_key))
    with pytest.raises(AccessError, match="can't be read"):
        protection_of(settings(tmp_path, tls_cert=one.server, tls_key=tmp_path / "nothing"))
    with pytest.raises(AccessError, match=r"contains no (PEM )?certificate"):
        protection_of(settings(tmp_path, tls_cert=one.server, tls_key=one.server_key, tls_ca=one.hashes))


def test_expired_certificate_is_refused_and_init_renews_it(tmp_path):
    prepare(tmp_path, sans=("lab.example",), now=NOW - timedelta(days=3000))
    folder = AccessFolder(tmp_path)
    authority = folder.ca.read_bytes()
    with pytest.raises(AccessError, match="expired"):
        protection_of(settings(tmp_path))
    prepare(tmp_path, sans=())
    assert protection_of(settings(tmp_path)).tls.authority == authority
    assert "lab.example" in names_in(folder.server.read_bytes())


def test_certificate_is_renewed_in_its_last_month_only(tmp_path):
    prepare(tmp_path, sans=(), now=NOW)
    certificate = AccessFolder(tmp_path).server.read_bytes()
    assert life_left(certificate, NOW) == timedelta(days=730)
    prepare(tmp_path, sans=(), now=NOW + timedelta(days=699))
    assert AccessFolder(tmp_path).server.read_bytes() == certificate
    prepare(tmp_path, sans=(), now=NOW + timedelta(days=701))
    assert AccessFolder(tmp_path).server.read_bytes() != certificate


def test_signing_needs_the_authority_key(tmp_path):
    prepare(tmp_path, sans=())
    AccessFolder(tmp_path).ca_key.unlink()
    prepare(tmp_path, sans=())
    with pytest.raises(AccessError, match=r"ca\.key is missing"):
        prepare(tmp_path, sans=("new.example",))


def test_invalid_certificate_name_is_refused():
    authority = make_authority("test", NOW)
    for name in ("", "two words", "http://x", "é.example"):
        with pytest.raises(ValueError, match="neither a host name nor an IP address"):
            make_server_certificate(authority, [name], NOW)


def test_handed_out_folder_holds_one_role(tmp_path):
    prepare(tmp_path / "data", sans=(), roles=(AccessRole.ADMIN, AccessRole.WORKER))
    hand_out_to(tmp_path / "data", AccessRole.WORKER, tmp_path / "w")
    assert {path.name for path in (tmp_path / "w").iterdir()} == {"ca.pem", "token"}
    AccessFolder(tmp_path / "data").token(AccessRole.WORKER).unlink()
    hand_out_to(tmp_path / "data", AccessRole.WORKER, tmp_path / "w")
    with pytest.raises(AccessError, match="token issue --role worker"):
        hand_out_to(tmp_path / "data", AccessRole.WORKER, tmp_path / "elsewhere")


async def test_role_token_cannot_be_the_shared_token(tmp_path):
    prepare(tmp_path, sans=())
    folder = AccessFolder(tmp_path)
    store = open_store("memory:")
    await store.claim(Candidate("test", "127.0.0.1:1", 60.0))
    gate = Gate(store, guarded=True, shared_token=folder.token(AccessRole.TRAINER).read_text().strip())
    with pytest.raises(AccessError, match="role of an admin"):
        await gate.open(folder.first_credentials())


def test_invitation_round_trips_and_errors_hide_the_token(tmp_path):
    prepare(tmp_path, sans=())
    pinned = fingerprint_of(AccessFolder(tmp_path).ca.read_text())
    for address in ("lab.example:50070", "[::1]:1", "a:1,b:2"):
        for fingerprint in ("", pinned):
            written = Invitation(address, "ab12.secret_-9", fingerprint)
            assert Invitation.parse(str(written)) == written
    for wrong in ("", "secret", "a.secret@", "a.secret@host", "@host:1", "a.b.c@host:1", "a.secret@host:1,"):
        with pytest.raises(InvalidRequestError, match="expected TOKEN@HOST:PORT") as caught:
            Invitation.parse(wrong)
        assert "secret" not in str(caught.value)


def test_text_of_many_unfinished_certificates_is_given_up_soon():
    began_s = time.process_time()
    with pytest.raises(ValueError, match="no certificate"):
        fingerprint_of("-----BEGIN CERTIFICATE-----\n" * 100_000)
    assert time.process_time() - began_s < 2.0


def test_files_that_hold_no_token_or_certificate_are_named(tmp_path):
    (tmp_path / "token").write_text("ab.cd\n")
    assert read_token(f"@{tmp_path / 'token'}") == "ab.cd"
    assert read_token("ab.cd") == "ab.cd"
    assert read_ca(None) == b""
    with pytest.raises(InvalidRequestError, match="can't be read"):
        read_token(f"@{tmp_path / 'nothing'}")
    with pytest.raises(InvalidRequestError, match="null byte"):
        read_token("@\0")
    with pytest.raises(InvalidRequestError, match="home directory"):
        read_token("@~unknown_user/token")
    with pytest.raises(InvalidRequestError, match=r"contains no (PEM )?certificate"):
        read_ca(tmp_path / "token")
    with pytest.raises(InvalidRequestError, match="can't be read"):
        read_ca(tmp_path / "nothing")
