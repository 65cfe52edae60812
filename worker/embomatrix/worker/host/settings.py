"""Settings of a worker daemon: parsed once, at the command line."""

import secrets
import socket
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field, field_validator

from embomatrix.rpc.channel import DEFAULT_ADDRESS, TOKEN_PATTERN
from embomatrix.rpc.managers import Managers
from embomatrix.rpc.status import InvalidRequestError
from embomatrix.rpc.wire.session import MAX_LABELS
from embomatrix.worker.host.owner_policy import Preferences


class WorkerSettings(BaseModel):
    """Settings of a worker daemon. Zeros are replaced by measured values."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    manager: str = DEFAULT_ADDRESS
    """HOST:PORT of the manager, or of several separated by commas. Only the worker opens connections."""
    token: str = Field("", repr=False, pattern=TOKEN_PATTERN)
    """Token of the worker role, or ``@FILE`` that holds it; empty if the manager requires none."""
    join: str = Field("", repr=False)
    """Invitation TOKEN@HOST:PORT; it replaces manager, token and ca."""
    ca: Path | None = None
    """Certificate of the authority that signed the manager's; None: no TLS."""
    state_dir: Path = Path("~/.local/share/embomatrix/worker")
    """Folder of the credentials that managers gave this machine."""
    name: str = Field(default_factory=lambda: default_name(), pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")
    """Worker id. Two daemons of one name take the session from each other, so the default has a random part."""
    slots: int = Field(0, ge=0, le=1024)
    """Rollouts that may run at the same time. 0: as many as there are cores."""
    memory_mb: int = Field(0, ge=0)
    """Memory for all resident scenes together. 0: ``memory_share`` of what is free."""
    memory_share: float = Field(0.4, gt=0, le=1)
    """Share of the memory that is free, and within the control group's limit, at the start."""
    slot_memory_mb: int = Field(2048, ge=64)
    """Memory that one rollout may allocate beyond what its scene holds."""
    sharing: bool = True
    """Execute the calls that plans have in common once. Results are equal without it, and take longer."""
    cache_dir: Path = Path("~/.cache/embomatrix/worker")
    """Folder of fetched bundles and of the simulator's log."""
    cache_mb: int = Field(1024, ge=1)
    """Disk space for bundles; the least recently used are evicted first."""
    nice: int = Field(10, ge=0, le=19)
    """Nice value of the CPU, 0 to 19. Above 0 the disk has idle priority, too."""
    labels: dict[str, str] = Field(default_factory=dict, max_length=MAX_LABELS)
    """Labels of this machine for operators."""
    preferences: Preferences = Field(default_factory=lambda: Preferences.model_validate({}))
    """Owner's preferences of when this machine works."""
    send_log: bool = True
    """Send the latest log lines, without secrets, to the manager, whose operators see them."""
    drain_s: float = Field(60.0, gt=0)
    """Time for running rollouts to end after a signal."""
    once: bool = False
    """Exit if the manager can't be reached, instead of retrying."""

    @field_validator("manager")
    @classmethod
    def _check_address(cls, value: str) -> str:
        try:
            Managers(value)
        except InvalidRequestError as error:
            raise ValueError("not HOST:PORT") from error
        return value


def default_name() -> str:
    """Return the host name with a random part."""
    host = "".join(
        char if char.isalnum() or char == "-" else "-" for char in socket.gethostname().split(".")[0]
    )
    return f"{host.strip('-')[:40] or 'worker'}-{secrets.token_hex(3)}"
