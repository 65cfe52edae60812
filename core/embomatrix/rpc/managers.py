"""Several managers of one cluster, of which one leads: where to turn to, and where next."""

from __future__ import annotations

import asyncio
import functools
import time
from typing import TYPE_CHECKING, Any, Concatenate, Final, ParamSpec, Protocol, TypeVar

from embomatrix.rpc.channel import DEFAULT_ADDRESS, is_address
from embomatrix.rpc.status import InvalidRequestError, StandbyError, UnavailableError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    import grpc

    from embomatrix.rpc.status import ClusterError

PAUSE_S: Final = 0.2
"""Between two calls of different managers."""
PATIENCE_S: Final = 20.0
"""For another manager to take over, where several were told."""
P = ParamSpec("P")
T = TypeVar("T")
C = TypeVar("C", bound="ManagerClient")


def addresses_of(text: str) -> tuple[str, ...]:
    """The managers in ``HOST:PORT,HOST:PORT``. Raises InvalidRequestError."""
    addresses = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    for address in addresses:
        if not is_address(address):
            raise InvalidRequestError(
                f"{address!r} is no address of a manager: expected HOST:PORT, as in {DEFAULT_ADDRESS}, or several with "
                "commas between them"
            )
    return addresses


class Channels:
    """A channel to each manager that was turned to. Those that were left stay open: other calls may still be on them."""

    def __init__(self, managers: Managers, open_to: Callable[[str], grpc.aio.Channel]) -> None:
        self._managers = managers
        self._open_to = open_to
        self._open: dict[str, grpc.aio.Channel] = {}

    def present(self) -> grpc.aio.Channel:
        """That to the present manager."""
        address = self._managers.current
        if address not in self._open:
            self._open[address] = self._open_to(address)
        return self._open[address]

    async def close(self) -> None:
        for channel in self._open.values():
            await channel.close()


class ManagerClient(Protocol):
    """A client of several managers."""

    @property
    def managers(self) -> Managers: ...

    @property
    def patience_s(self) -> float: ...


def of_the_leader(
    method: Callable[Concatenate[C, P], Awaitable[T]],
) -> Callable[Concatenate[C, P], Coroutine[Any, Any, T]]:
    """A call that is made anew, of the next manager, while the present one can't serve and there are several."""

    @functools.wraps(method)
    async def ask(self: C, /, *args: P.args, **options: P.kwargs) -> T:
        ends_s = time.monotonic() + self.patience_s
        while True:
            try:
                return await method(self, *args, **options)
            except UnavailableError as error:
                if self.managers.count == 1 or time.monotonic() >= ends_s:
                    raise
                self.managers.move(error)
            await asyncio.sleep(PAUSE_S)

    return ask


class Managers:
    """The addresses that a worker or trainer was told, one of them the present one."""

    def __init__(self, text: str) -> None:
        self._addresses = addresses_of(text)
        self.current = self._addresses[0]

    @property
    def count(self) -> int:
        return len(self._addresses)

    def move(self, error: ClusterError) -> None:
        """After a failed call: to the leader that the present manager named, else to the next in turn.

        Only addresses that were told from the start count: nobody is led elsewhere with a token in the hand.
        """
        if isinstance(error, StandbyError) and error.leader in self._addresses:
            self.current = error.leader
            return
        turn = self._addresses.index(self.current) + 1
        self.current = self._addresses[turn % len(self._addresses)]
