"""Commands that ask a manager: their common options, their client, and how its errors are shown."""

import asyncio
import functools
import inspect
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Annotated, Final

import typer

from embomatrix.host.failure import fail
from embomatrix.rpc.admin_client import AdminClient
from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.rpc.managers import FAILOVER_S
from embomatrix.rpc.options import Ca, Manager, Token, set_parameters
from embomatrix.rpc.status import ClusterError
from embomatrix.rpc.trust import read_ca, read_token

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
_OPTIONS: Final = (("manager", Manager, DEFAULT_ADDRESS), ("token", Token, ""), ("ca", Ca, None))


def manager_command(
    name: str,
    *,
    timeout_s: float = FAILOVER_S,
    until_interrupted: bool = False,
) -> Callable[[Callable[..., Coroutine[None, None, None]]], Callable[..., None]]:
    """Make a typer command of an async function whose first parameter is an open client.

    Adds --manager, --token and --ca. Errors are shown for `embomatrix NAME`. ``timeout_s`` bounds the wait for a manager
    that is away. With ``until_interrupted``, Ctrl-C is the normal end.
    """
    expected = (KeyboardInterrupt, BrokenPipeError) if until_interrupted else ()

    def decorate(function: Callable[..., Coroutine[None, None, None]]) -> Callable[..., None]:
        @functools.wraps(function, updated=())
        def run(*, manager: str, token: str = "", ca: Path | None = None, **arguments: object) -> None:
            async def ask() -> None:
                secret, trusted = read_token(token), read_ca(ca)
                async with AdminClient(manager, secret, ca=trusted, failover_s=timeout_s) as connected:
                    await function(connected, **arguments)

            try:
                asyncio.run(ask())
            except ClusterError as error:
                fail(name, str(error))
            except expected:
                return

        own = list(inspect.signature(function, eval_str=True).parameters.values())[1:]
        options = [
            inspect.Parameter(option, inspect.Parameter.KEYWORD_ONLY, annotation=kind, default=default)
            for option, kind, default in _OPTIONS
        ]
        set_parameters(run, [*own, *options])
        return run

    return decorate
