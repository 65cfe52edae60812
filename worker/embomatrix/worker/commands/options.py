"""Options of the subcommands of `embomatrix worker`, and one-sentence errors instead of tracebacks."""

import functools
import importlib.util
import platform
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from pydantic import ValidationError

from embomatrix.host import failure
from embomatrix.rpc.channel import DEFAULT_ADDRESS
from embomatrix.worker.host.owner_policy import Preferences
from embomatrix.worker.host.settings import WorkerSettings

EXPECTED: Final[Mapping[str, str]] = {
    "manager": f"expected HOST:PORT, as in {DEFAULT_ADDRESS}",
    "name": "expected up to 64 letters, digits, '.', '_' and '-'",
}
"""Expected values of settings whose validator only knows a pattern."""
fail = functools.partial(failure.fail, "worker")
"""Print a sentence to standard error and exit with status 2."""

StateDir = Annotated[
    Path | None,
    typer.Option(help="Folder of this machine's credentials and its workers' status.", show_default=False),
]


def parse(values: dict[str, Any]) -> WorkerSettings:
    """Validate the settings, or exit with a sentence about the first wrong one."""
    try:
        return WorkerSettings.model_validate(
            {key: value for key, value in values.items() if value is not None}
        )
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][-1])
        if first["type"] == "extra_forbidden":
            model = Preferences if first["loc"][0] == "preferences" else WorkerSettings
            key, known = ".".join(map(str, first["loc"])), ", ".join(sorted(model.model_fields))
            fail(f"--config: {key} is not a setting: expected one of {known}")
        if name in {"token", "join"}:
            # The value is not shown: it may be almost the secret.
            fail(f"--{name}: expected visible ASCII characters without spaces")
        message = first["msg"].removeprefix("Value error, ")
        expected = EXPECTED.get(name) or message[:1].lower() + message[1:]
        fail(f"--{name.replace('_', '-')} {first['input']!r}: {expected}")


def check_engine() -> None:
    """Exit with a sentence if the engine is not installed, without importing it."""
    if importlib.util.find_spec("pybullet") is None:
        fail(
            f"a worker needs the physics engine pybullet, which Python {platform.python_version()} on "
            f"{platform.machine()} does not have: use Python 3.11 on x86-64 Linux and install it with "
            "`pip install 'embomatrix[worker]'`"
        )
