"""`embomatrix manager`: serve a Simulation Manager, or ask one how it does."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003  # typer reads the annotation when the command runs
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.manager.settings import ManagerSettings

app = typer.Typer(
    help="Serve a Simulation Manager, or ask one how the cluster does.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

Token = Annotated[
    str, typer.Option(envvar="EMBOMATRIX_TOKEN", help="Shared secret of the cluster.", show_default=False)
]


@app.command()
def serve(
    host: Annotated[str, typer.Option(help="Address for workers and trainers.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="gRPC port; 0 takes a free one.")] = 50070,
    http_host: Annotated[str, typer.Option(help="Address of the status page.")] = "127.0.0.1",
    http_port: Annotated[int, typer.Option(help="Port of the status page; 0 takes a free one.")] = 8070,
    state: Annotated[
        str,
        typer.Option(
            help="memory: | sqlite:PATH | redis://HOST:PORT/DB. Default: a file in the data folder."
        ),
    ] = "",
    advertise: Annotated[
        str, typer.Option(help="HOST:PORT under which others reach this manager, if not where it serves.")
    ] = "",
    data_dir: Annotated[
        Path | None, typer.Option(help="Folder of bundles and state.", show_default=False)
    ] = None,
    token: Token = "",
    insecure_bind: Annotated[
        bool, typer.Option("--insecure-bind", help="Serve outside this machine without a token.")
    ] = False,
    log_level: Annotated[str, typer.Option(help="debug, info, warning or error.")] = "info",
) -> None:
    """Serve until interrupted."""
    options = {
        "host": host,
        "port": port,
        "http_host": http_host,
        "http_port": http_port,
        "state": state,
        "advertise": advertise,
        "token": token,
        "insecure_bind": insecure_bind,
        **({"data_dir": data_dir} if data_dir is not None else {}),
    }
    _log_to_stderr(log_level)
    _serve(_settings(options))


@app.command()
def status(
    manager: Annotated[
        str,
        typer.Option("--manager", "--address", help="HOST:PORT of the manager.", envvar="EMBOMATRIX_MANAGER"),
    ] = "127.0.0.1:50070",
    token: Token = "",
) -> None:
    """Show workers and runs of a manager."""
    import asyncio

    from embomatrix.manager.status_table import show_status
    from embomatrix.rpc.status import ClusterError

    try:
        asyncio.run(show_status(manager, token))
    except ClusterError as error:
        _refuse(str(error))


def _settings(options: Mapping[str, object]) -> ManagerSettings:
    from pydantic import ValidationError

    from embomatrix.manager.settings import ManagerSettings

    try:
        return ManagerSettings.model_validate(options)
    except ValidationError as error:
        first = error.errors()[0]
        expected = first["msg"].removeprefix("Value error, ")
        if not first["loc"]:
            _refuse(expected)
        name = str(first["loc"][0])
        if name == "token":
            # What was found stays untold: it may be nearly the secret.
            _refuse("--token: expected visible ASCII characters without spaces")
        _refuse(f"--{name.replace('_', '-')} {first['input']!r}: {expected[:1].lower()}{expected[1:]}")


def _serve(settings: ManagerSettings) -> None:
    import asyncio

    from embomatrix.manager.app import Endpoints, serve
    from embomatrix.manager.listen import PortInUseError
    from embomatrix.manager.store.protocol import StateError
    from embomatrix.manager.store.url import without_password

    def on_ready(endpoints: Endpoints) -> None:
        kept = (
            "nowhere: it is lost on restart"
            if settings.state_url == "memory:"
            else f"in {without_password(settings.state_url)}"
        )
        print(
            f"manager serves at {endpoints.address}, status page {endpoints.status_url}, state {kept}",
            flush=True,
        )

    def on_standby(leader: str) -> None:
        print(f"manager stands by: the one at {leader} leads", flush=True)

    problem = ""
    try:
        asyncio.run(serve(settings, on_ready, on_standby))
    except* (PortInUseError, StateError) as group:
        problem = str(_first_of(group))
    if problem:
        _refuse(problem)


def _first_of(group: BaseExceptionGroup[BaseException]) -> BaseException:
    """The first failure, however deep task groups have wrapped it."""
    first = group.exceptions[0]
    return _first_of(first) if isinstance(first, BaseExceptionGroup) else first


def _log_to_stderr(level: str) -> None:
    import logging

    if level.upper() not in logging.getLevelNamesMapping():
        _refuse(f"--log-level {level!r}: expected debug, info, warning or error")
    logging.basicConfig(level=level.upper(), format="%(asctime)s %(levelname)s %(name)s %(message)s")


def _refuse(sentence: str) -> NoReturn:
    """One sentence and exit status 2: what a person can mend gets no traceback."""
    typer.echo(f"embomatrix manager: {sentence}", err=True)
    raise typer.Exit(2)
