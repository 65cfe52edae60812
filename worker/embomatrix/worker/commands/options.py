"""What the subcommands of `embomatrix worker` share: options, and sentences instead of tracebacks."""

from __future__ import annotations

import importlib.util
import platform
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, NoReturn

import typer
from pydantic import ValidationError
from rich.console import Console

from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.worker.host.preferences import Preferences
from embomatrix.worker.host.settings import WorkerSettings

if TYPE_CHECKING:
    from collections.abc import Mapping

EXPECTED: Final[Mapping[str, str]] = {
    "manager": f"expected HOST:PORT, as in {DEFAULT_ADDRESS}",
    "name": "expected up to 64 letters, digits, '.', '_' and '-'",
}
"""What to say of a wrong value where the validator only knows a pattern."""

Manager = Annotated[
    str, typer.Option(help="HOST:PORT of the manager, or of several: A,B.", envvar="EMBOMATRIX_MANAGER")
]
Token = Annotated[
    str,
    typer.Option(
        envvar="EMBOMATRIX_TOKEN", help="Token of a worker, or @FILE that holds it.", show_default=False
    ),
]
Ca = Annotated[
    Path | None,
    typer.Option(
        envvar="EMBOMATRIX_CA", help="The ca.pem of a manager that serves by TLS.", show_default=False
    ),
]
StateDir = Annotated[
    Path | None,
    typer.Option(help="Folder of this machine's credentials and of its workers' status.", show_default=False),
]


def parse(values: dict[str, Any]) -> WorkerSettings:
    """The settings, or the end of the program with a sentence about the first that is wrong."""
    try:
        return WorkerSettings.model_validate(
            {key: value for key, value in values.items() if value is not None}
        )
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][-1])
        if first["type"] == "extra_forbidden":
            fields = Preferences if first["loc"][0] == "preferences" else WorkerSettings
            key, known = ".".join(map(str, first["loc"])), ", ".join(sorted(fields.model_fields))
            fail(f"--config: {key} is no setting: expected one of {known}")
        if name in {"token", "join"}:
            # What was found stays untold: it may be nearly the secret.
            fail(f"--{name}: expected visible ASCII characters without spaces")
        said = first["msg"].removeprefix("Value error, ")
        expected = EXPECTED.get(name) or said[:1].lower() + said[1:]
        fail(f"--{name.replace('_', '-')} {first['input']!r}: {expected}")


def check_engine() -> None:
    """End with a sentence where the engine is not installed; it is not imported here."""
    if importlib.util.find_spec("pybullet") is None:
        fail(
            f"a worker needs the physics engine pybullet, and this Python {platform.python_version()} on "
            f"{platform.machine()} has none: use Python 3.11 on x86-64 Linux and install it with "
            "`pip install 'embomatrix[worker]'`"
        )


def fail(sentence: str) -> NoReturn:
    """End the program with status 2 and a sentence on standard error."""
    Console(stderr=True, soft_wrap=True).print(
        f"embomatrix worker: {sentence}", highlight=False, markup=False
    )
    raise typer.Exit(2)
