"""Log that `embomatrix cluster events` follows, also through a restart of the manager."""

import itertools

from embomatrix.cli.cluster.app import log_events
from embomatrix.rpc.wire.run_log import EventKind, EventPage, RunEvent

PAGE = 3


def events(*sequences, began_s):
    return [RunEvent(number, began_s + number, EventKind.WORKER_JOINED) for number in sequences]


class Logs:
    """Log of each manager in turn; the next one leads after so many empty pages."""

    def __init__(self, *logs):
        self.logs = list(logs)

    async def read(self, after):
        beyond = [event for event in self.logs[0] if event.sequence > after]
        if len(beyond) <= 1 and len(self.logs) > 1:
            del self.logs[0]
        return EventPage(tuple(beyond[:PAGE]), 0)


async def followed(count, *logs):
    found = []
    async for event in log_events(Logs(*logs).read, follow=True, pause_s=0.0):
        found.append(event)
        if len(found) == count:
            return found
    raise AssertionError("a followed log has no end")


async def test_log_is_printed_once_and_ends_without_following():
    log = events(1, 2, 5, 8, 9, 11, 12, began_s=100.0)
    assert [event async for event in log_events(Logs(log).read, follow=False)] == log
    assert [event async for event in log_events(Logs([]).read, follow=False)] == []


async def test_log_of_the_next_manager_is_read_from_its_begin():
    old = events(1, 2, 3, 4, 5, began_s=100.0)
    for new in (
        events(1, 2, began_s=200.0),
        events(1, 5, began_s=200.0),
        events(*range(1, 9), began_s=200.0),
    ):
        found = await followed(len(old) + len(new), old, new)
        assert found == [*old, *new]


async def test_log_that_dropped_the_last_known_event_continues_with_the_oldest_kept_one():
    whole = events(*range(1, 10), began_s=100.0)
    kept = itertools.islice(whole, 5, None)
    assert await followed(7, whole[:3], list(kept)) == [*whole[:3], *whole[5:]]
