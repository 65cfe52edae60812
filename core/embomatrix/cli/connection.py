"""The options by which a command reaches a manager: where it is, who asks, and whose certificate to trust."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Manager = Annotated[str, typer.Option(help="HOST:PORT of the manager.", envvar="EMBOMATRIX_MANAGER")]
Token = Annotated[
    str, typer.Option(envvar="EMBOMATRIX_TOKEN", help="A token, or @FILE that holds it.", show_default=False)
]
Ca = Annotated[
    Path | None,
    typer.Option(
        envvar="EMBOMATRIX_CA", help="The ca.pem of a manager that serves by TLS.", show_default=False
    ),
]
