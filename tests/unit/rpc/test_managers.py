"""Selection of a manager among several addresses."""

import pytest

from embomatrix.rpc.managers import Managers
from embomatrix.rpc.status import InvalidRequestError, StandbyError, UnavailableError


def test_unreachable_managers_are_tried_in_turn():
    managers = Managers("a:1, b:2,c:3")
    seen = []
    for _ in range(4):
        seen.append(managers.current)
        managers.move(UnavailableError("nobody answers"))
    assert seen == ["a:1", "b:2", "c:3", "a:1"]


def test_client_follows_the_leader_named_by_a_standby():
    managers = Managers("a:1,b:2,c:3")
    managers.move(StandbyError("c leads", "c:3"))
    assert managers.current == "c:3"


def test_unknown_leader_addresses_are_ignored():
    managers = Managers("a:1,b:2")
    managers.move(StandbyError("follow me", "evil:1"))
    assert managers.current == "b:2"


def test_single_manager_is_retried():
    managers = Managers("a:1")
    managers.move(UnavailableError("nobody answers"))
    assert managers.current == "a:1"
    assert managers.count == 1


@pytest.mark.parametrize("text", ["", "a", "a:1,", "a:1;b:2", "a:0"])
def test_invalid_addresses_are_refused(text):
    with pytest.raises(InvalidRequestError, match="expected HOST:PORT"):
        Managers(text)
