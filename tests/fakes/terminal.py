"""Commands typed in the test's own process and working folder."""

import contextlib
import io
import os
import shlex
import sys
from unittest.mock import patch

from embomatrix.cli.main import main


def typed(line: str) -> tuple[int, str]:
    """Run `embomatrix LINE`; return its exit status and what it printed, on any number of columns."""
    output = io.StringIO()
    status = 0
    with (
        patch.dict(os.environ, {"COLUMNS": "1000", "NO_COLOR": "1"}),
        patch.object(sys, "argv", ["embomatrix", *shlex.split(line)]),
        contextlib.redirect_stdout(output),
        contextlib.redirect_stderr(output),
    ):
        try:
            main()
        except SystemExit as ended:
            status = int(ended.code or 0)
    return status, output.getvalue()
