"""Options of commands: those that name a manager, and those made of settings."""

import enum
import inspect
import tomllib
from collections.abc import Callable, Collection, Iterable
from pathlib import Path
from typing import Annotated, Any, NoReturn, Protocol

import typer
from pydantic import BaseModel

from embomatrix.rpc.logs import LogFormat

Manager = Annotated[
    str, typer.Option(help="HOST:PORT of the manager, or of several: A,B.", envvar="EMBOMATRIX_MANAGER")
]
Token = Annotated[
    str, typer.Option(help="Access token, or @FILE.", envvar="EMBOMATRIX_TOKEN", show_default=False)
]
Ca = Annotated[
    Path | None,
    typer.Option(help="The ca.pem of a manager with TLS.", envvar="EMBOMATRIX_CA", show_default=False),
]
LogLines = Annotated[
    LogFormat, typer.Option(help="Format of log lines: human or json.", envvar="EMBOMATRIX_LOG_FORMAT")
]


class CommandLine(Protocol):
    """Parsed command line: values by option name, and the source of each."""

    params: dict[str, Any]

    def get_parameter_source(self, name: str, /) -> enum.Enum | None: ...


def given_options(context: CommandLine) -> dict[str, Any]:
    """Return the options that come from the command line or the environment."""
    sources = {name: context.get_parameter_source(name) for name in context.params}
    return {
        name: context.params[name]
        for name, source in sources.items()
        if source is not None and not source.name.startswith("DEFAULT")
    }


def read_config(path: Path, refuse: Callable[[str], NoReturn]) -> dict[str, Any]:
    """Read the TOML file of ``--config``. Its values are validated with the options."""
    try:
        return tomllib.loads(path.expanduser().read_text(encoding="utf-8"))
    except OSError as error:
        refuse(f"--config {path}: the file can't be read ({error.strerror or error}): name a TOML file")
    except (ValueError, RecursionError) as error:
        refuse(f"--config {path}: {error}: expected a TOML file")


def add_settings(
    command: Callable[..., object],
    *models: type[BaseModel],
    skip: Collection[str] = (),
    panel: str | None = None,
) -> None:
    """Add an option for each setting that the command does not declare. The command takes them as keyword arguments.

    The type, the default and the help text are those of the setting; its docstring is the help text.
    """
    own = inspect.signature(command, eval_str=True).parameters.values()
    parameters = {one.name: one for one in own if one.kind is not inspect.Parameter.VAR_KEYWORD}
    for model in models:
        for name, field in model.model_fields.items():
            if name in parameters or name in skip:
                continue
            default = None if field.is_required() or field.default_factory else field.default
            word = name.replace("_", "-")
            is_switch = field.annotation == bool | None or default is True
            option = typer.Option(
                f"--{word}/--no-{word}" if is_switch else f"--{word}",
                help=(field.description or "").replace("``", "`"),
                show_default=bool(default),
                rich_help_panel=panel,
            )
            kind: Any = Annotated[field.annotation, option]
            parameters[name] = inspect.Parameter(
                name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind
            )
    set_parameters(command, parameters.values())


def set_parameters(command: Any, parameters: Iterable[inspect.Parameter]) -> None:
    """Have typer read these parameters, all of them by name, instead of the command's own."""
    named = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in parameters]
    command.__signature__ = inspect.Signature(named)
    command.__annotations__ = {one.name: one.annotation for one in named}
