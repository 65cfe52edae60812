"""Address of a cluster from arguments and from the variables that our commands read."""

import os
from pathlib import Path
from typing import NamedTuple

from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.trust import read_ca, read_token


class ClusterAddress(NamedTuple):
    """Address of a manager, HOST:PORT, a token for it, and the certificate (PEM) of the authority to trust."""

    manager: str
    token: str
    ca: bytes


def cluster_named(manager: str = "", token: str = "", ca: str | Path = "") -> ClusterAddress:
    """Return the address of a cluster, by default that of the manager on this machine.

    Defaults come from ``EMBOMATRIX_MANAGER``, ``EMBOMATRIX_TOKEN`` (or @FILE) and ``EMBOMATRIX_CA``, as for our commands.
    Raises InvalidRequestError for a file that can't be read.
    """
    authority = str(ca) or os.environ.get("EMBOMATRIX_CA", "")
    return ClusterAddress(
        manager or os.environ.get("EMBOMATRIX_MANAGER", "") or DEFAULT_ADDRESS,
        read_token(token or os.environ.get("EMBOMATRIX_TOKEN", "")),
        read_ca(Path(authority) if authority else None),
    )
