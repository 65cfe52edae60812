"""`embomatrix manager`: serve a manager, prepare its access folder, and manage tokens."""

from __future__ import annotations

import functools
import logging
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, TypeVar

import typer
from pydantic import ValidationError

from embomatrix.host.commands import command_group
from embomatrix.host.failure import fail
from embomatrix.host.printable import printable
from embomatrix.manager.settings import ManagerSettings
from embomatrix.rpc.logs import LogFormat, hide, log_to_stderr, without_secrets
from embomatrix.rpc.options import Ca, LogLines, Manager, Token, add_settings, given_options, read_config
from embomatrix.rpc.status import ClusterError, InvalidRequestError
from embomatrix.rpc.trust import Invitation, fingerprint_of, read_ca, read_token
from embomatrix.rpc.wire.tokens import AccessRole, TokenInfo
from embomatrix.starter.options import DATASET_VARIABLE

if TYPE_CHECKING:
    from embomatrix.rpc.admin_client import AdminClient

app = command_group(help="Serve a manager, create its certificates, and manage its tokens.")

logger = logging.getLogger(__name__)

token_app = command_group(help="Issue, list and revoke tokens.")
app.add_typer(token_app, name="token")
T = TypeVar("T")
OPTIONS: Final = {
    *("host", "port", "advertise", "http_host", "http_port", "data_dir", "dataset", "state", "audit"),
    *("tls_cert", "tls_key", "tls_ca", "insecure_bind"),
}
"""Settings with an option of `manager serve`. Only the file of --config sets the others."""
_refuse = functools.partial(fail, "manager")
"""Print one sentence and exit with status 2."""


@app.command()
def serve(
    context: typer.Context,
    token: Annotated[
        str,
        typer.Option(
            envvar="EMBOMATRIX_TOKEN",
            help="Shared secret with the role of an admin, in addition to issued tokens; or @FILE.",
            show_default=False,
        ),
    ] = "",
    dataset: Annotated[
        Path | None,
        typer.Option(
            envvar=DATASET_VARIABLE,
            help="Folder of the dataset whose tasks the dashboard shows, or starter for all tasks that ship. It is never "
            "written. Default: none.",
            show_default=False,
        ),
    ] = None,
    log_level: Annotated[
        str,
        typer.Option(help="debug, info, warning or error; debug also checks invariants."),
    ] = "info",
    log_format: LogLines = LogFormat.HUMAN,
    config: Annotated[
        Path | None,
        typer.Option(
            help="TOML file of these and further settings (docs/protocol.md); options take precedence."
        ),
    ] = None,
    **_: object,
) -> None:
    """Serve until interrupted."""
    _log_to_stderr(log_level, log_format)
    file = read_config(config, _refuse) if config is not None else {}
    settings = _settings(given_options(context), file)
    hide(settings.token)
    if settings.dataset is not None:
        settings = settings.model_copy(update={"dataset": _shown_dataset(settings.dataset)})
    _serve(settings)


def _shown_dataset(named: Path) -> Path:
    """Return the folder of a dataset, or of all tasks that ship if it has the name of a shipped one.

    Refuse a folder that is missing, and log why a folder's tasks can't be shown yet. The manager starts nevertheless, because
    the dataset may be written or repaired while it serves.
    """
    # Imported here: a manager without a dataset saves the 13 MB of memory that numpy and the code of scenes take.
    from embomatrix.manager.web.gallery import no_tasks_yet
    from embomatrix.starter.shipped import is_named, unpacked_tasks
    from embomatrix.world.dataset import TASKS_FILE, Dataset, DatasetError

    folder = named
    try:
        if is_named(named):
            folder = unpacked_tasks()
        Dataset.load(folder)
    except OSError as error:
        _refuse(f"the tasks that ship can't be unpacked: {error}")
    except DatasetError as error:
        if not folder.is_dir():
            _refuse(str(error))
        there = (folder / TASKS_FILE).exists()
        logger.warning("%s", error if there else no_tasks_yet(folder))
    return folder


add_settings(serve, ManagerSettings, skip=ManagerSettings.model_fields.keys() - OPTIONS)


@app.command()
def init(
    data_dir: Annotated[
        Path | None, typer.Option(help="Folder of bundles and the state file.", show_default=False)
    ] = None,
    san: Annotated[
        list[str] | None,
        typer.Option(help="Additional name or address of this machine; may be repeated.", show_default=False),
    ] = None,
    hand_out: Annotated[
        list[str] | None,
        typer.Option(
            metavar="ROLE:FOLDER",
            help="Also copy ca.pem and a token of the role to FOLDER.",
            show_default=False,
        ),
    ] = None,
    compose: Annotated[
        bool, typer.Option("--compose", help="Name the next commands as Docker Compose runs them.")
    ] = False,
) -> None:
    """Create certificates and first tokens for a manager that other machines reach. Existing files stay.

    The last lines name the next commands: serve, write tasks, train, and find the results.
    """
    from embomatrix.manager.access.folder import FIRST_ROLES, AccessError, hand_out_to, prepare
    from embomatrix.manager.commands.next_steps import COMPOSE_STEPS, host_steps

    folder = _settings({"data_dir": data_dir}).data_dir
    recipients = [_recipient(text) for text in hand_out or ()]
    roles = tuple(dict.fromkeys((*FIRST_ROLES, *(role for role, _ in recipients))))
    try:
        done = prepare(folder, sans=san or (), roles=roles)
        for role, target in recipients:
            hand_out_to(folder, role, target)
    except AccessError as error:
        _refuse(str(error))
    for sentence in done.made:
        print(f"made   {sentence}")
    for sentence in done.found:
        print(f"there  {sentence}")
    for step in COMPOSE_STEPS if compose else host_steps(folder, named=data_dir is not None):
        print(f"next   {step.purpose}: {step.command}")


def _recipient(text: str) -> tuple[AccessRole, Path]:
    """Parse ``ROLE:FOLDER``."""
    name, _, target = text.partition(":")
    if name not in (AccessRole.WORKER, AccessRole.TRAINER, AccessRole.VIEWER, AccessRole.ADMIN) or not target:
        _refuse(f"--hand-out {text!r}: expected worker:FOLDER, trainer:FOLDER, viewer:FOLDER or admin:FOLDER")
    return AccessRole(name), Path(target)


def _token(text: str) -> str:
    try:
        return read_token(text)
    except InvalidRequestError as error:
        _refuse(str(error))


def _settings(options: Mapping[str, object], file: Mapping[str, object] | None = None) -> ManagerSettings:
    """Merge the settings file with the options of the same names, or exit with a sentence about a wrong one."""
    known = ManagerSettings.model_fields
    given = {name: value for name, value in options.items() if name in known and value is not None}
    values = {**(file or {}), **given}
    if isinstance(token := values.get("token"), str):
        values["token"] = _token(token)
    try:
        return ManagerSettings.model_validate(values)
    except ValidationError as error:
        first = error.errors()[0]
        expected = first["msg"].removeprefix("Value error, ")
        if not first["loc"]:
            _refuse(expected)
        name = str(first["loc"][0])
        if name == "token":
            # The value is not shown: it may be almost the secret.
            _refuse("--token: expected visible ASCII characters without spaces")
        if first["type"] == "extra_forbidden":
            _refuse(f"--config: unknown setting {name!r}: correct its name or remove it")
        shown = f"--{name.replace('_', '-')}" if name in OPTIONS else f"--config: {name}"
        _refuse(f"{shown} {first['input']!r}: {expected[:1].lower()}{expected[1:]}")


def _serve(settings: ManagerSettings) -> None:
    import asyncio

    from embomatrix.manager.access.folder import AccessError
    from embomatrix.manager.services.app import Endpoints, serve
    from embomatrix.manager.services.listen import PortInUseError
    from embomatrix.manager.store.protocol import StateError

    def on_ready(endpoints: Endpoints) -> None:
        lost = settings.state_url == "memory:"
        kept = "nowhere: it is lost on restart" if lost else f"in {without_secrets(settings.state_url)}"
        print(
            f"manager serves at {endpoints.address}, status page {endpoints.status_url}, state {kept}",
            flush=True,
        )

    def on_standby(leader: str) -> None:
        print(f"manager stands by: the manager at {leader} leads", flush=True)

    problem = ""
    try:
        asyncio.run(serve(settings, on_ready, on_standby))
    except* (AccessError, PortInUseError, StateError) as group:
        problem = str(_first_of(group))
    if problem:
        _refuse(problem)


def _first_of(group: BaseExceptionGroup[BaseException]) -> BaseException:
    """Return the first failure in nested groups."""
    first = group.exceptions[0]
    return _first_of(first) if isinstance(first, BaseExceptionGroup) else first


def _log_to_stderr(level: str, log_format: LogFormat) -> None:
    try:
        log_to_stderr(level, log_format)
    except ValueError as error:
        _refuse(f"--log-level {level!r}: {error}")


@token_app.command()
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
    if role not in list(AccessRole):
        _refuse(f"--role {role!r}: expected one of {', '.join(AccessRole)}")
    wanted = AccessRole(role)
    new, token_id = _ask(
        manager, token, ca, lambda client: client.issue_token(wanted, valid_s=hours * 3600.0, label=label)
    )
    if wanted is not AccessRole.JOIN:
        print(printable(new))
        typer.echo(f"id {printable(token_id)}; the token is not shown again", err=True)
        return
    pem = read_ca(ca).decode("ascii")
    print(printable(str(Invitation(manager, new, fingerprint_of(pem) if pem else ""))))
    typer.echo("on the machine that joins: embomatrix worker run --join with the line above", err=True)


@token_app.command(name="list")
def list_(manager: Manager = "127.0.0.1:50070", token: Token = "", ca: Ca = None) -> None:
    """List the valid tokens by id."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table("id", "role", "label", "valid for", "worker")
    for info in _ask(manager, token, ca, lambda client: client.list_tokens()):
        values = (info.token_id, info.role, info.label, _left(info), info.worker_id)
        table.add_row(*(Text(printable(value)) for value in values))
    Console().print(table)


@token_app.command()
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

    async def ask() -> T:
        async with AdminClient(manager, read_token(token), ca=read_ca(ca)) as client:
            return await question(client)

    call: Coroutine[Any, Any, T] = ask()
    try:
        return asyncio.run(call)
    except ClusterError as error:
        _refuse(str(error))
