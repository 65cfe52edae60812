"""`embomatrix manager token`: issue, list and revoke tokens."""

from __future__ import annotations

from pathlib import Path  # typer evaluates the annotation
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import typer

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Coroutine

    from embomatrix.rpc.admin_client import AdminClient
    from embomatrix.rpc.wire.tokens import TokenInfo

app = typer.Typer(
    help="Issue, list and revoke tokens.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
T = TypeVar("T")

Manager = Annotated[
    str,
    typer.Option("--manager", "--address", help="HOST:PORT of the manager.", envvar="EMBOMATRIX_MANAGER"),
]
Token = Annotated[
    str,
    typer.Option(envvar="EMBOMATRIX_TOKEN", help="Token of an admin, or @FILE.", show_default=False),
]
Ca = Annotated[
    Path | None,
    typer.Option(
        envvar="EMBOMATRIX_CA", help="CA certificate (ca.pem) of a manager with TLS.", show_default=False
    ),
]


@app.command()
def issue(
    role: Annotated[str, typer.Option(help="Role: join, worker, trainer, viewer or admin.")],
    label: Annotated[str, typer.Option(help="Label for lists, such as the owner's name.")] = "",
    hours: Annotated[
        float, typer.Option(min=0.0, help="Validity in hours; 0: until revoked, or one day for a join token.")
    ] = 0.0,
    manager: Manager = "127.0.0.1:50070",
    token: Token = "",
    ca: Ca = None,
) -> None:
    """Issue a token. It is shown once: the manager keeps only a hash."""
    from embomatrix.rpc.trust import Invitation, fingerprint_of, read_ca
    from embomatrix.rpc.wire.tokens import AccessRole

    if role not in list(AccessRole):
        _refuse(f"--role {role!r}: expected {', '.join(AccessRole)}")
    wanted = AccessRole(role)
    new, token_id = _ask(
        manager, token, ca, lambda client: client.issue_token(wanted, valid_s=hours * 3600.0, label=label)
    )
    if wanted is not AccessRole.JOIN:
        print(new)
        typer.echo(f"id {token_id}; the token is not shown again", err=True)
        return
    pem = read_ca(ca).decode("ascii")
    print(Invitation(manager, new, fingerprint_of(pem) if pem else ""))
    typer.echo("on the machine that joins: embomatrix worker run --join with the line above", err=True)


@app.command(name="list")
def list_(manager: Manager = "127.0.0.1:50070", token: Token = "", ca: Ca = None) -> None:
    """List the valid tokens by id."""
    from rich.console import Console
    from rich.table import Table

    table = Table("id", "role", "label", "valid for", "worker")
    for info in _ask(manager, token, ca, lambda client: client.list_tokens()):
        table.add_row(info.token_id, info.role, info.label, _left(info), info.worker_id)
    Console().print(table)


@app.command()
def revoke(
    token_id: Annotated[str, typer.Argument(help="Token id, as `list` shows it.")],
    manager: Manager = "127.0.0.1:50070",
    token: Token = "",
    ca: Ca = None,
) -> None:
    """Revoke a token. Worker sessions that it opened end at once."""
    _ask(manager, token, ca, lambda client: client.revoke_token(token_id))
    print(f"revoked {token_id}")


def _left(info: TokenInfo) -> str:
    return f"{info.left_s / 3600:.1f} h" if info.left_s else "until revoked"


def _ask(manager: str, token: str, ca: Path | None, question: Callable[[AdminClient], Awaitable[T]]) -> T:
    """Call the manager; errors end the command with one sentence."""
    import asyncio

    from embomatrix.rpc.admin_client import AdminClient
    from embomatrix.rpc.status import ClusterError
    from embomatrix.rpc.trust import read_ca, read_token

    async def ask() -> T:
        async with AdminClient(manager, read_token(token), ca=read_ca(ca)) as client:
            return await question(client)

    call: Coroutine[Any, Any, T] = ask()
    try:
        return asyncio.run(call)
    except ClusterError as error:
        _refuse(str(error))


def _refuse(sentence: str) -> NoReturn:
    typer.echo(f"embomatrix manager token: {sentence}", err=True)
    raise typer.Exit(2)
