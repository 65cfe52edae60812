"""Commands that follow `embomatrix manager init`: serve, write tasks, train, and look at the results."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from embomatrix.manager.access.folder import AccessFolder
from embomatrix.rpc.wire.tokens import AccessRole
from embomatrix.starter.options import DEFAULT_DATASET


@dataclass(frozen=True, slots=True)
class NextStep:
    """Purpose of a command, and the command as a person types it."""

    purpose: str
    command: str


COMPOSE_STEPS: Final = (
    NextStep(
        "write the shipped tasks, which the dashboard then shows",
        "docker compose run --rm trainer factory starter --out=/dataset",
    ),
    NextStep("train on them", "docker compose run --rm trainer train --out=/runs/first"),
    NextStep(
        "copy all results to ./runs",
        "docker compose run --rm -T --no-deps --entrypoint=tar trainer -cC / runs | tar -xo",
    ),
)
"""Commands in the checkout's folder. The head of docker-compose.yml lists the same ones."""


def host_steps(data_dir: Path, *, named: bool) -> tuple[NextStep, ...]:
    """Return the commands for a manager on this machine. ``named`` if ``data_dir`` is not the default folder."""
    folder = AccessFolder(data_dir)
    serve = ("embomatrix", "manager", "serve", *([f"--data-dir={data_dir}"] if named else ()))
    access = (f"--token=@{folder.token(AccessRole.TRAINER)}", f"--ca={folder.ca}")
    train = ("embomatrix", "train", *access, f"--dataset={DEFAULT_DATASET}", "--out=runs/first")
    return (
        NextStep("write the shipped tasks", f"embomatrix factory starter --out={DEFAULT_DATASET}"),
        NextStep(
            "serve, with the tasks in the dashboard", shlex.join((*serve, f"--dataset={DEFAULT_DATASET}"))
        ),
        NextStep(
            "check the connection from this machine; on another, with its own copy of ca.pem and with --manager HOST:PORT",
            shlex.join(("embomatrix", "doctor", *access)),
        ),
        NextStep("train on the tasks, with the results in runs/first", shlex.join(train)),
    )
