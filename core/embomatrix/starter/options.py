"""The option `--dataset`, the same in all commands, and the refusal of the argument that it replaced."""

import os
import shlex
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from typer.core import TyperCommand

from embomatrix.host.failure import fail

DATASET_VARIABLE: Final = "EMBOMATRIX_DATASET"
"""Environment variable with the dataset of commands to which none is given."""
DEFAULT_DATASET: Final = Path("build/dataset")
"""Dataset of commands to which none is given, if the variable is not set."""
DatasetFolder = Annotated[
    Path, typer.Option("--dataset", help="Folder of the dataset.", envvar=DATASET_VARIABLE)
]
"""Dataset of a command; the default is ``DEFAULT_DATASET``."""
DatasetOrName = Annotated[
    Path,
    typer.Option(
        "--dataset",
        help="Folder of the dataset, or one that ships: starter, search or internal-verified-2.",
        envvar=DATASET_VARIABLE,
    ),
]
"""Dataset of a factory command that changes none; the default is ``DEFAULT_DATASET``. ``shipped.open_dataset`` opens it."""
DatasetOrShipped = Annotated[
    Path | None,
    typer.Option(
        "--dataset",
        help="Folder of the dataset, or one that ships: starter, search or internal-verified-2. "
        f"Default: {DEFAULT_DATASET}, or starter if there is none.",
        envvar=DATASET_VARIABLE,
        show_default=False,
    ),
]
"""Dataset of a command for one person; the default None stands for ``shipped.dataset_folder``. ``open_dataset`` opens it."""


def default_dataset() -> Path:
    """Return $EMBOMATRIX_DATASET, or else build/dataset."""
    return Path(os.environ.get(DATASET_VARIABLE) or DEFAULT_DATASET)


class DatasetCommand(TyperCommand):
    """Command without arguments that refuses a dataset given as one, and names the option."""

    allow_extra_args = True

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the options. Exit with status 2 if anything is left."""
        left = super().parse_args(ctx, args)
        if left and not ctx.resilient_parsing:
            fail(
                ctx.command_path.removeprefix("embomatrix "),
                f"{left[0]!r} is not an option: give the dataset as --dataset {shlex.quote(left[0])}",
            )
        return left
