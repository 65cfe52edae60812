"""Settings of the manager: parsed once, at the edge; an unknown key is an error."""

from __future__ import annotations

import ipaddress
import socket
from pathlib import Path
from typing import Self

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from embomatrix.rpc.channel import TOKEN_PATTERN, is_address

DEFAULT_PORT = 50070
DEFAULT_HTTP_PORT = 8070


class ManagerSettings(BaseModel):
    """How a manager serves. Outside loopback it needs certificates and tokens: see ``access.protection``."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    host: str = "127.0.0.1"
    """Address on which workers and trainers are served."""
    port: int = Field(DEFAULT_PORT, ge=0, le=65535)
    """TCP port of the gRPC services; 0 takes a free one."""
    advertise: str = ""
    """HOST:PORT under which workers and trainers reach this manager, told by another that stands by. Empty: where it serves."""
    http_host: str = "127.0.0.1"
    """Address of the status page."""
    http_port: int = Field(DEFAULT_HTTP_PORT, ge=0, le=65535)
    """TCP port of the status page; 0 takes a free one."""
    data_dir: Path = Field(
        default_factory=lambda: Path.home() / ".local" / "share" / "embomatrix" / "manager"
    )
    """Folder of bundles and of the embedded state."""
    dataset: Path | None = None
    """Folder of a dataset whose tasks the dashboard shows. It is read, never written."""
    state: str = ""
    """``memory:``, ``sqlite:PATH`` or ``redis://HOST:PORT/DB``. Empty: a file in the data folder."""
    token: str = Field("", repr=False, pattern=TOKEN_PATTERN)
    """One secret that is an admin's for everybody, beside the tokens of roles; empty: there is none."""
    tls_cert: Path | None = None
    """Certificate of the manager (PEM), the authority's after it. None: that of ``manager init``, if it is there."""
    tls_key: Path | None = None
    """Its private key."""
    tls_ca: Path | None = None
    """Certificate of the authority that signed it; what invitations of workers are pinned to."""
    insecure_bind: bool = False
    """Serve outside loopback without certificates and tokens."""
    bundle_total_mb: int = Field(16_384, ge=1)
    """Largest size of all bundles, in MB."""
    heartbeat_s: float = Field(1.0, gt=0)
    """Seconds between two heartbeats of a worker; grows with the cluster."""
    lost_after_s: float = Field(10.0, gt=0)
    """A worker that was silent for this long is given up."""
    stream_grace_s: float = Field(1.0, ge=0)
    """A worker whose connection broke may come back within this time."""
    lease_ttl_s: float = Field(30.0, gt=0)
    """A lease that no heartbeat renews for this long is void."""
    lease_limit_s: float = Field(180.0, gt=0)
    """A lease that is not answered after this long is void."""
    execute_deadline_s: float = Field(60.0, gt=0)
    """A worker kills a slot that executes one plan for longer."""
    rollout_deadline_s: float = Field(600.0, gt=0)
    """From submission to outcome."""
    no_capacity_s: float = Field(60.0, gt=0)
    """How long rollouts wait while no worker could take them."""
    affinity_wait_s: float = Field(0.5, ge=0)
    """How long rollouts wait for workers that have their scene before idle ones load it, while its load time isn't known."""
    hedge_after_s: float = Field(1.0, gt=0)
    """No rollout is late, and started a second time elsewhere, before it has run for this long."""
    hedge_share: float = Field(0.05, ge=0, le=1)
    """Largest share of a run's rollouts that are started a second time; 0: none."""
    stall_after_s: float = Field(10.0, gt=0)
    """No lease has stalled before it has done no step for this long."""
    max_attempts: int = Field(3, ge=1)
    """Started leases of one rollout before it ends as an infrastructure failure."""
    restart_grace_s: float = Field(5.0, ge=0)
    """How long a manager that took over waits for workers to say what they run, before it gives the same to others."""
    leader_ttl_s: float = Field(6.0, gt=0)
    """A manager that did not renew its lead for this long may be replaced by one that stands by."""
    audit: bool | None = None
    """Have other workers execute a part of the results once more, and compare. None: unless all workers are on this
    machine. Runs that ask for verified results have it done in any case."""
    audit_probation: int = Field(50, ge=0)
    """So many executions of a new worker are compared, all of them."""
    audit_share: float = Field(0.05, ge=0, le=1)
    """Of its later results."""
    results_ttl_s: float = Field(3600.0, gt=0)
    """How long results are kept after their batch ended."""

    @property
    def state_url(self) -> str:
        return self.state or f"sqlite:{self.data_dir / 'state.sqlite'}"

    @property
    def address(self) -> str:
        """HOST:PORT as others should use it."""
        everywhere = self.host in ("0.0.0.0", "::")  # it is asked for, not chosen
        host = socket.gethostname() if everywhere else self.host
        return self.advertise or f"{f'[{host}]' if ':' in host else host}:{self.port}"

    @property
    def audits_all_runs(self) -> bool:
        """Whether results of runs that did not ask for it are audited as well."""
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
    """Whether only this machine can reach the address."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def is_every_address(host: str) -> bool:
    """Whether it stands for all addresses of this machine, and so is none that a browser could open."""
    try:
        return ipaddress.ip_address(host).is_unspecified
    except ValueError:
        return False
