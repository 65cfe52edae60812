"""Membership file: a worker keeps the credentials of its managers."""

import stat

import pytest

from embomatrix.rpc.status import InvalidRequestError
from embomatrix.worker.host.settings import WorkerSettings
from embomatrix.worker.link.membership import Membership, MembershipFile, authority_of, membership_of

KEPT = Membership("lab.example:50070", "spare", "own.credential", b"PEM")


async def test_membership_without_a_token_comes_from_the_settings(tmp_path):
    settings = WorkerSettings(manager="a:1,b:2", name="w1", state_dir=tmp_path)
    assert await membership_of(settings) == Membership("a:1,b:2", "w1")


async def test_credential_takes_precedence_over_its_token(tmp_path):
    settings = WorkerSettings(manager="elsewhere:1", name="w1", token="join.secret", state_dir=tmp_path)
    assert (await membership_of(settings)).token == "join.secret"
    MembershipFile(tmp_path, "join.secret").keep(KEPT)
    assert await membership_of(settings) == KEPT


async def test_invitation_is_identified_by_its_token_and_may_change_the_address(tmp_path):
    MembershipFile(tmp_path, "join.secret").keep(KEPT)
    moved = WorkerSettings(join="join.secret@moved.example:50070", state_dir=tmp_path)
    found = await membership_of(moved)
    assert (found.manager, found.name, found.token) == ("moved.example:50070", "spare", "own.credential")
    assert not found.joining


def test_authority_of_a_joined_manager_is_found_by_its_address(tmp_path):
    assert authority_of("lab.example:50070", tmp_path / "nowhere") == b""
    (tmp_path / "member-0.json").write_text("{}")
    MembershipFile(tmp_path, "join.secret").keep(KEPT)
    assert authority_of("lab.example:50070", tmp_path) == b"PEM"
    assert authority_of("other.example:50070", tmp_path) == b""


def test_each_token_has_a_private_file_that_does_not_name_it(tmp_path):
    for token in ("join.secret", "other.secret"):
        MembershipFile(tmp_path / "state", token).keep(KEPT)
    files = list((tmp_path / "state").iterdir())
    assert len(files) == 2
    for path in files:
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
        assert "secret" not in path.name + path.read_text()


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"manager": 1}', "\x00"])
def test_damaged_file_is_named_with_the_remedy(tmp_path, content):
    file = MembershipFile(tmp_path, "join.secret")
    file.keep(KEPT)
    [path] = tmp_path.iterdir()
    path.write_text(content)
    with pytest.raises(InvalidRequestError, match=rf"{path.name} can't be read .*join with a new token"):
        file.read()
