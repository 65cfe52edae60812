"""Settings of a worker daemon: parsed once, at the command line."""

from __future__ import annotations

import secrets
import socket
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, field_validator

from embomatrix.rpc.channel import DEFAULT_ADDRESS, TOKEN_PATTERN
from embomatrix.rpc.managers import Managers
from embomatrix.rpc.status import InvalidRequestError
from embomatrix.rpc.wire.session import MAX_LABELS
from embomatrix.worker.host.preferences import Preferences


class WorkerSettings(BaseModel):
    """What a daemon is told. Zeros mean: measure this machine and decide."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    manager: str = DEFAULT_ADDRESS
    """HOST:PORT of the manager, or of several with commas between; the worker dials out, nothing needs to reach it."""
    token: str = Field("", repr=False, pattern=TOKEN_PATTERN)
    """Token of the worker role, or ``@FILE`` that holds it; empty where the manager asks for none."""
    join: str = Field("", repr=False)
    """TOKEN@HOST:PORT, all that joining takes; it stands in for manager, token and ca."""
    ca: Path | None = None
    """Certificate of the authority that signed the manager's; None: no TLS."""
    state_dir: Path = Path("~/.local/share/embomatrix/worker")
    """Folder of the credentials that managers gave this machine."""
    name: str = Field(default_factory=lambda: default_name(), pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")
    """Worker id. Two daemons of one name take the session from each other, so the default is never the same twice."""
    slots: int = Field(0, ge=0, le=1024)
    """Rollouts that may run at the same time. 0: as many as there are cores."""
    memory_mb: int = Field(0, ge=0)
    """Memory for all resident scenes together. 0: ``memory_share`` of what is free."""
    memory_share: float = Field(0.4, gt=0, le=1)
    """Of the memory that is free when the worker starts, and that its control group leaves it."""
    slot_memory_mb: int = Field(2048, ge=64)
    """Memory that one rollout may allocate beyond what its scene holds."""
    cache_dir: Path = Path("~/.cache/embomatrix/worker")
    """Folder of fetched bundles and of the simulator's log."""
    cache_mb: int = Field(1024, ge=1)
    """Disk space for bundles; the longest unused go first."""
    nice: int = Field(10, ge=0, le=19)
    """Politeness towards the machine's owner: higher leaves more to others. Above 0 the disk is left to others too."""
    labels: dict[str, str] = Field(default_factory=dict, max_length=MAX_LABELS)
    """What the operator calls this machine by."""
    preferences: Preferences = Field(default_factory=lambda: Preferences.model_validate({}))
    """When this machine works."""
    drain_s: float = Field(60.0, gt=0)
    """How long running rollouts may take to end after a signal."""
    once: bool = False
    """End when the manager can't be reached, instead of trying again."""

    @field_validator("manager")
    @classmethod
    def _check_address(cls, value: str) -> str:
        try:
            Managers(value)
        except InvalidRequestError as error:
            raise ValueError("not HOST:PORT") from error
        return value


def default_name() -> str:
    """Host name and a random part."""
    host = "".join(
        char if char.isalnum() or char == "-" else "-" for char in socket.gethostname().split(".")[0]
    )
    return f"{host.strip('-')[:40] or 'worker'}-{secrets.token_hex(3)}"
