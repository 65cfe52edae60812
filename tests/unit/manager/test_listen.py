"""Ports that cannot be bound, and masked passwords in state URLs."""

import socket

import pytest

from embomatrix.manager.services.listen import PortInUseError, bound_socket
from embomatrix.rpc.logs import without_secrets


def test_free_port_is_bound_and_released():
    with bound_socket("127.0.0.1", 0) as first:
        port = first.getsockname()[1]
    with bound_socket("127.0.0.1", port) as again:
        assert again.getsockname()[1] == port


def test_port_in_use_names_the_address_and_the_option():
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        wanted = rf"127\.0\.0\.1:{port} can't be bound \(Address already in use\): .*--http-port"
        with pytest.raises(PortInUseError, match=wanted), bound_socket("127.0.0.1", port, option="http-"):
            pass


def test_address_of_another_machine_suggests_another_host():
    with (
        pytest.raises(PortInUseError, match="pass an address of this machine as --host"),
        bound_socket("203.0.113.7", 0),
    ):
        pass


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("redis://:secret@host:6379/0", "redis://:***@host:6379/0"),
        ("rediss://me:se:cret@host/0", "rediss://me:***@host/0"),
        ("redis://host:6379/0", "redis://host:6379/0"),
        ("sqlite:/a/b@c.sqlite", "sqlite:/a/b@c.sqlite"),
    ],
)
def test_password_of_a_state_url_is_not_shown(url, shown):
    assert without_secrets(url) == shown
