"""Addresses and tokens are validated before any call."""

import pytest

from embomatrix.rpc.channel import is_address, open_channel
from embomatrix.rpc.status import InvalidRequestError


@pytest.mark.parametrize("text", ["127.0.0.1:50070", "manager:1", "[::1]:65535", "a.b-c.example:50070"])
def test_host_and_port_are_an_address(text):
    assert is_address(text)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "manager",
        "manager:",
        ":50070",
        "manager:0",
        "manager:65536",
        "http://manager:80",
        "a b:1",
        "::1:5",
    ],
)
def test_other_texts_are_no_address(text):
    assert not is_address(text)


async def test_wrong_address_error_shows_the_expected_form():
    with pytest.raises(InvalidRequestError, match=r"'nowhere' .* expected HOST:PORT"):
        open_channel("nowhere")


@pytest.mark.parametrize("token", ["a b", "wröng", "line\n"])
async def test_unsendable_token_is_refused_and_not_shown(token):
    with pytest.raises(InvalidRequestError, match="visible ASCII") as refusal:
        open_channel("127.0.0.1:1", token)
    assert token.strip() not in str(refusal.value)
