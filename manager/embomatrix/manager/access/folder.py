"""Folder ``access`` of a data folder: authority, certificate and first tokens, made by ``manager init``."""

import json
import socket
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from embomatrix.host.failure import unwritable
from embomatrix.manager.access.certificates import (
    RENEWAL,
    KeyPair,
    life_left,
    make_authority,
    make_server_certificate,
    names_in,
)
from embomatrix.manager.access.credentials import LONGEST_JOIN_S, Credential, CredentialBook
from embomatrix.manager.settings import LOOPBACK_NAMES
from embomatrix.rpc.trust import fingerprint_of
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import write_whole

FIRST_ROLES: Final = (AccessRole.ADMIN, AccessRole.TRAINER, AccessRole.VIEWER, AccessRole.JOIN)
_PUBLIC: Final = 0o644
_SECRET: Final = 0o600


class AccessError(Exception):
    """Unusable or missing certificates or tokens. The message names a remedy."""


@dataclass(slots=True)
class PreparedAccess:
    """Report of ``prepare``: sentences about created and existing files."""

    made: list[str] = field(default_factory=list)
    found: list[str] = field(default_factory=list)


class AccessFolder:
    """Paths in the access folder."""

    def __init__(self, data_dir: Path) -> None:
        self.path = data_dir / "access"
        self.ca = self.path / "ca.pem"
        self.ca_key = self.path / "ca.key"
        self.server = self.path / "server.pem"
        self.server_key = self.path / "server.key"
        self.hashes = self.path / "tokens.json"
        """Hashes of the first tokens, which the manager reads."""

    def token(self, role: AccessRole) -> Path:
        """Return the file with the first token of a role."""
        return self.path / "tokens" / role.value

    def first_credentials(self) -> tuple[Credential, ...]:
        """Return the first credentials. Raises AccessError."""
        try:
            return tuple(map(Credential.of, parse_json(self.hashes.read_bytes())))
        except (FileNotFoundError, NotADirectoryError):
            return ()
        except OSError as error:
            raise AccessError(
                f"{self.hashes} can't be read ({error.strerror}): check its permissions"
            ) from error
        except (ValueError, TypeError, KeyError) as error:
            raise AccessError(
                f"{self.hashes} can't be read ({error}): remove it and run `embomatrix manager init` again"
            ) from error


def prepare(
    data_dir: Path,
    *,
    sans: Iterable[str],
    roles: Sequence[AccessRole] = FIRST_ROLES,
    now: datetime | None = None,
) -> PreparedAccess:
    """Create missing files. Existing files stay; an authority is never overwritten.

    The server certificate is renewed if it lacks one of ``sans`` or expires soon. Raises AccessError.
    """
    folder = AccessFolder(data_dir)
    moment = now or datetime.now(UTC)
    done = PreparedAccess()
    try:
        folder.path.mkdir(parents=True, exist_ok=True, mode=0o700)
        authority = _authority(folder, moment, done)
        _certify(folder, authority, tuple(sans), moment, done)
        _first_tokens(folder, roles, moment, done)
    except OSError as error:
        raise AccessError(
            f"{error.filename or folder.path} can't be written ({error.strerror}): pass another --data-dir"
        ) from error
    return done


def hand_out_to(data_dir: Path, role: AccessRole, target: Path) -> None:
    """Copy the authority's certificate and the role's first token into a client's folder.

    An existing token there stays. Raises AccessError.
    """
    folder = AccessFolder(data_dir)
    try:
        target.mkdir(parents=True, exist_ok=True)
        if (target / "ca.pem").exists() and not (target / "token").exists():
            raise AccessError(
                f"{target / 'ca.pem'} was not handed out here: name another folder, or move it away"
            )
        write_whole(target / "ca.pem", folder.ca.read_bytes(), mode=_PUBLIC)
        if not (target / "token").exists():
            write_whole(target / "token", folder.token(role).read_bytes(), mode=_SECRET)
    except FileNotFoundError as error:
        raise AccessError(
            f"{error.filename} no longer exists: issue a token with `embomatrix manager token issue --role {role}`"
        ) from error
    except OSError as error:
        raise AccessError(unwritable(error.filename or target, error)) from error


def _authority(folder: AccessFolder, now: datetime, done: PreparedAccess) -> KeyPair:
    if folder.ca.exists():
        done.found.append(f"the authority {folder.ca}")
        return KeyPair(folder.ca.read_bytes(), folder.ca_key.read_bytes() if folder.ca_key.exists() else b"")
    authority = make_authority(f"EmboMatrix authority of {socket.gethostname()}", now)
    # The key is written first: a certificate without a key means an authority that is kept elsewhere.
    write_whole(folder.ca_key, authority.key, mode=_SECRET)
    write_whole(folder.ca, authority.certificate, mode=_PUBLIC)
    done.made.append(f"the authority {folder.ca}: clients pass it as --ca")
    return authority


def _certify(
    folder: AccessFolder, authority: KeyPair, sans: Sequence[str], now: datetime, done: PreparedAccess
) -> None:
    before: tuple[str, ...] = ()
    if folder.server.exists():
        certificate = folder.server.read_bytes()
        before = names_in(certificate)
        if set(sans) <= set(before) and life_left(certificate, now) > RENEWAL:
            done.found.append(f"the certificate {folder.server}, for {', '.join(before)}")
            return
    if not authority.key:
        raise AccessError(
            f"{folder.ca_key} is missing, so no certificate can be signed: restore the file for this command"
        )
    names = tuple(dict.fromkeys((*before, *sans, *LOOPBACK_NAMES, *_own_names())))
    try:
        pair = make_server_certificate(authority, names, now)
    except ValueError as error:
        raise AccessError(f"--san: {error}") from error
    write_whole(folder.server_key, pair.key, mode=_SECRET)
    write_whole(folder.server, pair.certificate, mode=_PUBLIC)
    done.made.append(f"the certificate {folder.server}, for {', '.join(names)}")


def _own_names() -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for name in (socket.gethostname(), socket.getfqdn()) if name.isascii()))


def _first_tokens(
    folder: AccessFolder, roles: Sequence[AccessRole], now: datetime, done: PreparedAccess
) -> None:
    credentials = list(folder.first_credentials())
    known = {credential.role for credential in credentials}
    book = CredentialBook()
    for role in roles:
        if role in known:
            done.found.append(f"a first token of the role {role}")
            continue
        path = folder.token(role)
        path.parent.mkdir(exist_ok=True, mode=0o700)
        valid_s = LONGEST_JOIN_S if role is AccessRole.JOIN else 0.0
        credential, token = book.issue(
            role, valid_s=valid_s, label="made by manager init", now_s=now.timestamp()
        )
        pinned = f".{fingerprint_of(folder.ca.read_text())}" if role is AccessRole.JOIN else ""
        write_whole(path, f"{token}{pinned}\n".encode(), mode=_SECRET)
        credentials.append(credential)
        done.made.append(
            f"a token of the role {role}: {path}" + (", valid for one worker and one day" if valid_s else "")
        )
    if len(credentials) > len(known):
        rows = [asdict(credential) for credential in credentials]
        write_whole(folder.hashes, json.dumps(rows, indent=1).encode(), mode=_SECRET)
