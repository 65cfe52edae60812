"""Addresses of the managers of one cluster, of which one leads and the others stand by."""

from typing import Final

from embomatrix.rpc.channel import DEFAULT_ADDRESS, is_address
from embomatrix.rpc.status import ClusterError, InvalidRequestError, StandbyError

FAILOVER_S: Final = 20.0
"""Default time to wait for another manager to take over, where several addresses are known."""


class Managers:
    """Manager addresses of a worker or trainer, and the one in use.

    ``text`` is ``HOST:PORT``, or several with commas between them. Raises InvalidRequestError.
    """

    def __init__(self, text: str) -> None:
        self.addresses = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
        for address in self.addresses:
            if not is_address(address):
                raise InvalidRequestError(
                    f"{address!r} is not a manager address: expected HOST:PORT, as in {DEFAULT_ADDRESS}, or several with "
                    "commas between them"
                )
        self.current = self.addresses[0]

    @property
    def count(self) -> int:
        return len(self.addresses)

    def move(self, error: ClusterError) -> None:
        """Switch to another manager after a failed call: to the leader that a standby named, else to the next address.

        A leader outside the configured addresses is ignored, since calls carry a token.
        """
        if isinstance(error, StandbyError) and error.leader in self.addresses:
            self.current = error.leader
            return
        following = self.addresses.index(self.current) + 1
        self.current = self.addresses[following % self.count]
