"""Where to turn to when a manager does not answer."""

import pytest

from embomatrix.rpc.managers import Managers
from embomatrix.rpc.status import InvalidRequestError, StandbyError, UnavailableError


def test_managers_take_turns():
    managers = Managers("a:1, b:2,c:3")
    seen = []
    for _ in range(4):
        seen.append(managers.current)
        managers.move(UnavailableError("nobody answers"))
    assert seen == ["a:1", "b:2", "c:3", "a:1"]


def test_a_standby_leads_to_the_leader_it_names():
    managers = Managers("a:1,b:2,c:3")
    managers.move(StandbyError("c leads", "c:3"))
    assert managers.current == "c:3"


def test_nobody_is_led_to_an_address_that_was_not_told():
    managers = Managers("a:1,b:2")
    managers.move(StandbyError("follow me", "evil:1"))
    assert managers.current == "b:2"


def test_a_lone_manager_stays_the_one():
    managers = Managers("a:1")
    managers.move(UnavailableError("nobody answers"))
    assert managers.current == "a:1"
    assert managers.count == 1


@pytest.mark.parametrize("text", ["", "a", "a:1,", "a:1;b:2", "a:0"])
def test_what_is_no_address_is_refused(text):
    with pytest.raises(InvalidRequestError, match="expected HOST:PORT"):
        Managers(text)
