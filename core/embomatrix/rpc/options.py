"""Options of the commands that connect to a manager or serve as one."""

from pathlib import Path
from typing import Annotated

import typer

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
