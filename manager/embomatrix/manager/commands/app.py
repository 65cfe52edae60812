"""`embomatrix manager`: serve a Simulation Manager, and manage its tokens."""

from __future__ import annotations

from pathlib import Path  # typer reads the annotation when the command runs
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from embomatrix.manager.commands.token import app as token_app
from embomatrix.rpc.logs import LogFormat, hide, log_to_stderr

if TYPE_CHECKING:
    from collections.abc import Mapping

    from embomatrix.manager.settings import ManagerSettings
    from embomatrix.rpc.roles import AccessRole

app = typer.Typer(
    help="Serve a Simulation Manager, and manage its tokens.",
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)

app.add_typer(token_app, name="token")

Token = Annotated[
    str, typer.Option(envvar="EMBOMATRIX_TOKEN", help="A token, or @FILE that holds it.", show_default=False)
]
DataDir = Annotated[Path | None, typer.Option(help="Folder of bundles and state.", show_default=False)]
ShownDataset = Annotated[
    Path | None, typer.Option(help="Folder of a dataset whose tasks the dashboard shows.", show_default=False)
]
State = Annotated[
    str,
    typer.Option(help="memory: | sqlite:PATH | redis://HOST:PORT/DB. Default: a file in the data folder."),
]
Advertise = Annotated[
    str, typer.Option(help="HOST:PORT under which others reach this manager, if not where it serves.")
]
SharedToken = Annotated[
    str,
    typer.Option(
        envvar="EMBOMATRIX_TOKEN",
        help="One secret that is an admin's for everybody, beside the tokens of roles; or @FILE that holds it.",
        show_default=False,
    ),
]
TlsCert = Annotated[
    Path | None, typer.Option(help="Certificate (PEM), else that of `init`.", show_default=False)
]
TlsKey = Annotated[Path | None, typer.Option(help="Its private key.", show_default=False)]
TlsCa = Annotated[Path | None, typer.Option(help="Certificate of who signed it.", show_default=False)]
InsecureBind = Annotated[
    bool, typer.Option("--insecure-bind", help="Serve outside this machine without TLS or tokens.")
]
Audit = Annotated[
    bool | None,
    typer.Option(
        "--audit/--no-audit",
        help="Compare results of every run between workers; by default where others may join.",
        show_default=False,
    ),
]
LogLines = Annotated[
    LogFormat, typer.Option(help="Log lines for people, or as JSON.", envvar="EMBOMATRIX_LOG_FORMAT")
]


@app.command()
def serve(
    host: Annotated[str, typer.Option(help="Address for workers and trainers.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="gRPC port; 0 takes a free one.")] = 50070,
    http_host: Annotated[str, typer.Option(help="Address of the status page.")] = "127.0.0.1",
    http_port: Annotated[int, typer.Option(help="Port of the status page; 0 takes a free one.")] = 8070,
    state: State = "",
    advertise: Advertise = "",
    data_dir: DataDir = None,
    dataset: ShownDataset = None,
    token: SharedToken = "",
    tls_cert: TlsCert = None,
    tls_key: TlsKey = None,
    tls_ca: TlsCa = None,
    insecure_bind: InsecureBind = False,
    audit: Audit = None,
    log_level: Annotated[
        str,
        typer.Option(help="debug, info, warning or error; debug also checks invariants."),
    ] = "info",
    log_format: LogLines = LogFormat.HUMAN,
) -> None:
    """Serve until interrupted."""
    options = {
        "host": host,
        "port": port,
        "http_host": http_host,
        "http_port": http_port,
        "state": state,
        "advertise": advertise,
        "dataset": dataset,
        "token": _token(token),
        "tls_cert": tls_cert,
        "tls_key": tls_key,
        "tls_ca": tls_ca,
        "insecure_bind": insecure_bind,
        "audit": audit,
        **({"data_dir": data_dir} if data_dir is not None else {}),
    }
    _log_to_stderr(log_level, log_format)
    settings = _settings(options)
    hide(settings.token)
    _serve(settings)


@app.command()
def init(
    data_dir: DataDir = None,
    san: Annotated[
        list[str] | None,
        typer.Option(help="A further name or address that clients call this machine by.", show_default=False),
    ] = None,
    hand_out: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROLE:FOLDER", help="Put ca.pem and a token of the role there too.", show_default=False
        ),
    ] = None,
) -> None:
    """Make certificates and first tokens for a manager that is served beyond this machine. What is there stays as it is."""
    from embomatrix.manager.access.folder import FIRST_ROLES, AccessError, hand_out_to, prepare

    folder = _settings({} if data_dir is None else {"data_dir": data_dir}).data_dir
    parcels = [_parcel(text) for text in hand_out or ()]
    roles = tuple(dict.fromkeys((*FIRST_ROLES, *(role for role, _ in parcels))))
    try:
        done = prepare(folder, sans=san or (), roles=roles)
        for role, target in parcels:
            hand_out_to(folder, role, target)
    except AccessError as error:
        _refuse(str(error))
    for sentence in done.made:
        print(f"made   {sentence}")
    for sentence in done.found:
        print(f"there  {sentence}")


def _parcel(text: str) -> tuple[AccessRole, Path]:
    """What ``ROLE:FOLDER`` asks for."""
    from pathlib import Path

    from embomatrix.rpc.roles import AccessRole

    name, _, target = text.partition(":")
    if name not in (AccessRole.WORKER, AccessRole.TRAINER, AccessRole.VIEWER, AccessRole.ADMIN) or not target:
        _refuse(f"--hand-out {text!r}: expected worker:FOLDER, trainer:FOLDER, viewer:FOLDER or admin:FOLDER")
    return AccessRole(name), Path(target)


def _token(text: str) -> str:
    from embomatrix.rpc.status import InvalidRequestError
    from embomatrix.rpc.trust import read_token

    try:
        return read_token(text)
    except InvalidRequestError as error:
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

    from embomatrix.manager.access.folder import AccessError
    from embomatrix.manager.runtime.app import Endpoints, serve
    from embomatrix.manager.runtime.listen import PortInUseError
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
    except* (AccessError, PortInUseError, StateError) as group:
        problem = str(_first_of(group))
    if problem:
        _refuse(problem)


def _first_of(group: BaseExceptionGroup[BaseException]) -> BaseException:
    """The first failure, however deep task groups have wrapped it."""
    first = group.exceptions[0]
    return _first_of(first) if isinstance(first, BaseExceptionGroup) else first


def _log_to_stderr(level: str, log_format: LogFormat) -> None:
    try:
        log_to_stderr(level, log_format)
    except ValueError as error:
        _refuse(f"--log-level {level!r}: {error}")


def _refuse(sentence: str) -> NoReturn:
    """One sentence and exit status 2: what a person can mend gets no traceback."""
    typer.echo(f"embomatrix manager: {sentence}", err=True)
    raise typer.Exit(2)
