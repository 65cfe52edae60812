"""Settings of the manager, parsed once at the command line. Unknown keys are errors."""

import ipaddress
import socket
from pathlib import Path
from typing import Final, Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from embomatrix.rpc.channel import TOKEN_PATTERN, is_address

DEFAULT_PORT = 50070
DEFAULT_HTTP_PORT = 8070
LOOPBACK_NAMES: Final = ("localhost", "127.0.0.1", "::1")


class ManagerSettings(BaseModel):
    """Settings of a manager. Outside loopback it needs certificates and tokens: see ``access.protection``."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    host: str = "127.0.0.1"
    """Address of the gRPC services."""
    port: int = Field(DEFAULT_PORT, ge=0, le=65535)
    """TCP port of the gRPC services; 0 takes a free one."""
    advertise: str = ""
    """HOST:PORT under which workers and trainers reach this manager, as a standby reports it. Empty: the serving
    address."""
    http_host: str = "127.0.0.1"
    """Address of the dashboard."""
    http_port: int = Field(DEFAULT_HTTP_PORT, ge=0, le=65535)
    """TCP port of the dashboard; 0 takes a free one."""
    data_dir: Path = Field(
        default_factory=lambda: Path.home() / ".local" / "share" / "embomatrix" / "manager"
    )
    """Folder of bundles and of the state file."""
    dataset: Path | None = None
    """Dataset whose tasks the dashboard shows. It is never written."""
    state: str = ""
    """``memory:``, ``sqlite:PATH`` or ``redis://HOST:PORT/DB``. Empty: a file in the data folder."""
    token: str = Field("", repr=False, pattern=TOKEN_PATTERN)
    """Shared secret with the role of an admin, in addition to issued tokens. Empty: none."""
    tls_cert: Path | None = None
    """Certificate chain of the manager (PEM). Default: that of ``manager init``, if present."""
    tls_key: Path | None = None
    """Private key of the certificate."""
    tls_ca: Path | None = None
    """Certificate of the signing authority; invitations carry its fingerprint."""
    insecure_bind: bool = False
    """Serve outside loopback without certificates and tokens."""
    bundle_total_mb: int = Field(16_384, ge=1)
    """Total size of all bundles, in MB."""
    heartbeat_s: float = Field(1.0, gt=0)
    """Seconds between two heartbeats of a worker; the interval grows with the cluster."""
    lost_after_s: float = Field(10.0, gt=0)
    """A worker is lost after this many seconds of silence."""
    stream_grace_s: float = Field(1.0, ge=0)
    """Seconds in which a worker may reconnect after its stream broke."""
    lease_ttl_s: float = Field(30.0, gt=0)
    """A lease expires after this many seconds without a heartbeat."""
    lease_limit_s: float = Field(180.0, gt=0)
    """A lease expires after this many seconds without a result."""
    execute_deadline_s: float = Field(60.0, gt=0)
    """A worker kills a slot that executes one plan for longer (seconds)."""
    rollout_deadline_s: float = Field(600.0, gt=0)
    """Seconds from submission to outcome."""
    no_capacity_s: float = Field(60.0, gt=0)
    """Seconds that rollouts wait while no worker can take them."""
    affinity_wait_s: float = Field(0.5, ge=0)
    """Seconds that rollouts wait for workers with their scene before idle workers load it, while its load time is
    unknown."""
    hedge_after_s: float = Field(1.0, gt=0)
    """A rollout must run for this many seconds before it can be hedged."""
    hedge_share: float = Field(0.05, ge=0, le=1)
    """Largest share of a run's rollouts that are hedged; 0: none."""
    stall_after_s: float = Field(10.0, gt=0)
    """A lease can stall only after this many seconds without a step."""
    max_attempts: int = Field(3, ge=1)
    """Started leases of one rollout before it ends in an infrastructure failure."""
    restart_grace_s: float = Field(5.0, ge=0)
    """Seconds that a new leader waits for workers to report their leases before it re-dispatches them."""
    leader_ttl_s: float = Field(6.0, gt=0)
    """A standby may take over after the leader has not renewed its lease for this many seconds."""
    audit: bool | None = None
    """Execute a share of the results again on other workers and compare. Default: only if workers on other machines may
    join. Runs with verified results are always audited."""
    audit_probation: int = Field(50, ge=0)
    """Number of first executions of a new worker that are all audited."""
    audit_share: float = Field(0.05, ge=0, le=1)
    """Audited share of later results."""
    results_ttl_s: float = Field(3600.0, gt=0)
    """Seconds that results are kept after their batch ended."""

    @property
    def state_url(self) -> str:
        return self.state or f"sqlite:{self.data_dir / 'state.sqlite'}"

    @property
    def address(self) -> str:
        """HOST:PORT under which others reach this manager."""
        everywhere = self.host in ("0.0.0.0", "::")  # compares a configured value, binds nothing
        host = socket.gethostname() if everywhere else self.host
        return self.advertise or f"{f'[{host}]' if ':' in host else host}:{self.port}"

    @property
    def audits_all_runs(self) -> bool:
        """True if results of all runs are audited, even without a request."""
        return not is_loopback(self.host) if self.audit is None else self.audit

    @field_validator("advertise")
    @classmethod
    def _check_address(cls, value: str) -> str:
        if value and not is_address(value):
            raise ValueError("expected HOST:PORT, as in cluster.example:50070")
        return value

    @model_validator(mode="after")
    def _pair_files(self) -> Self:
        if (self.tls_cert is None) != (self.tls_key is None):
            raise ValueError("--tls-cert and --tls-key belong together: pass both, or none")
        return self


def is_loopback(host: str) -> bool:
    """Return True if only this machine can reach the address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_every_address(host: str) -> bool:
    """Return True for a wildcard address, which no browser can open."""
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False
