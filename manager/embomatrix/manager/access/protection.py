"""Protection of a manager: TLS and tokens, which only loopback addresses may lack."""

import logging
import ssl
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path

from embomatrix.manager.access.certificates import RENEWAL, life_left, names_in
from embomatrix.manager.access.credentials import Credential
from embomatrix.manager.access.folder import AccessError, AccessFolder
from embomatrix.manager.settings import ManagerSettings, is_loopback
from embomatrix.rpc.trust import fingerprint_of

logger = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Tls:
    """Certificate of the server. ``chain``, ``key`` and ``authority`` are PEM; an unknown authority is empty."""

    chain_file: Path
    key_file: Path
    chain: bytes
    key: bytes = field(repr=False)
    authority: bytes
    names: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Protection:
    """``first`` are the tokens of ``manager init``; ``guarded`` if tokens are required."""

    tls: Tls | None
    first: tuple[Credential, ...]
    guarded: bool


def protection_of(settings: ManagerSettings) -> Protection:
    """Return the protection that settings and data folder provide. Raises AccessError if the served addresses need
    more.
    """
    folder = AccessFolder(settings.data_dir)
    tls = _tls(settings, folder)
    first = folder.first_credentials()
    guarded = bool(first or settings.token)
    lacking = [name for name, there in (("TLS", tls is not None), ("tokens", guarded)) if not there]
    for host in (settings.host, settings.http_host):
        if lacking and not is_loopback(host) and not settings.insecure_bind:
            raise AccessError(
                f"refusing to serve on {host} without {' and '.join(lacking)}: anyone there could use the cluster or read its "
                f"traffic; run `embomatrix manager init --data-dir {settings.data_dir} --san HOST` first, or pass "
                "--insecure-bind if the network is trusted"
            )
    return Protection(tls, first, guarded)


def _tls(settings: ManagerSettings, folder: AccessFolder) -> Tls | None:
    chain_file = settings.tls_cert or folder.server
    key_file = settings.tls_key or folder.server_key
    if settings.tls_cert is None and not folder.server.exists():
        return None
    ca_file = settings.tls_ca or (folder.ca if settings.tls_cert is None else None)
    try:
        chain, key = chain_file.read_bytes(), key_file.read_bytes()
        authority = b"" if ca_file is None else ca_file.read_bytes()
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(chain_file, key_file)
        names = names_in(chain)
        left = life_left(chain, datetime.now(UTC))
        if authority:
            fingerprint_of(authority.decode("ascii"))
    except ssl.SSLError as error:
        raise AccessError(
            f"{key_file} is not the key of the certificate {chain_file} ({error.reason}): pass a matching pair"
        ) from error
    except OSError as error:
        raise AccessError(
            f"{error.filename} can't be read ({error.strerror}): check --tls-cert, --tls-key and --tls-ca, or run "
            "`embomatrix manager init` for the data folder"
        ) from error
    except ValueError as error:
        raise AccessError(
            f"{chain_file} or {ca_file} contains no PEM certificate ({error}): "
            "pass the files that `embomatrix manager init` wrote"
        ) from error
    if left < timedelta(0):
        raise AccessError(
            f"the certificate {chain_file} expired {-left.days} days ago: `embomatrix manager init` renews the one of the "
            "data folder"
        )
    if left < RENEWAL:
        logger.warning("the certificate %s expires in %d days: renew it", chain_file, left.days)
    return Tls(chain_file, key_file, chain, key, authority, names)
