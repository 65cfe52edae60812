"""`embomatrix worker install`: a systemd unit that runs the worker whenever this machine runs."""

from __future__ import annotations

import re
import shutil
import stat
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer
from rich.console import Console

from embomatrix.worker.commands.options import fail
from embomatrix.worker.commands.run import settings_of

if TYPE_CHECKING:
    from collections.abc import Sequence

UNIT: Final = "embomatrix-worker.service"
USER_UNITS: Final = Path("~/.config/systemd/user")
SYSTEM_UNITS: Final = Path("/etc/systemd/system")
SYSTEM_STATE: Final = Path("/var/lib/embomatrix-worker")
"""The one folder that a unit of the whole machine may write; a manager's is another, for each has a user of its own."""
STOP_S: Final = 90
"""Longer than a drain takes, so that running rollouts may end."""
FILES: Final = frozenset({"--config", "--ca", "--token"})
"""Options that name a file to be read; ``--token`` by ``@FILE``."""
FOLDERS: Final = frozenset({"--cache-dir", "--state-dir"})
_PLAIN: Final = re.compile(r"[\w@%+=:,./-]+", re.ASCII)


def install(
    context: typer.Context,
    folder: Annotated[
        Path | None,
        typer.Option(help="Where to write the unit; by default where systemd looks.", show_default=False),
    ] = None,
    system: Annotated[
        bool, typer.Option("--system", help="For the whole machine, from its start on; needs root.")
    ] = False,
) -> None:
    """Write a systemd unit that runs `embomatrix worker run` with the options that follow `--`."""
    if sys.platform != "linux":
        fail("units are for systemd on Linux: on this system start `embomatrix worker run` at log-in instead")
    words = absolute(apart(context.args))
    command = program()
    _check(words)
    if system:
        _check_for_all(words, command)
    target = (folder or (SYSTEM_UNITS if system else USER_UNITS)).expanduser() / UNIT
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(unit_text(command, words, system=system), encoding="utf-8")
    except OSError as error:
        fail(f"{target} can't be written ({error.strerror or error}): use --folder, or root for --system")
    console = Console(soft_wrap=True)
    for line in (f"wrote {target}; now run", *next_steps(command, system=system)):
        console.print(line, highlight=False, markup=False)


def apart(arguments: Sequence[str]) -> list[str]:
    """Options and their values as words of their own, however they were written."""
    return [
        part
        for word in arguments
        for part in (word.split("=", 1) if word.startswith("--") and "=" in word else [word])
    ]


def absolute(words: Sequence[str]) -> list[str]:
    """The words with every path as it is meant here: a unit starts elsewhere, and knows no ``~``."""
    placed = list(words)
    for number, option in enumerate(words[:-1], start=1):
        value = words[number]
        if option == "--token" and value.startswith("@"):
            placed[number] = f"@{Path(value[1:]).expanduser().absolute()}"
        elif option in FOLDERS or (option in FILES and option != "--token"):
            placed[number] = str(Path(value).expanduser().absolute())
    return placed


def next_steps(command: Sequence[str], *, system: bool) -> list[str]:
    """What is to be typed after the unit was written."""
    manager = "sudo systemctl" if system else "systemctl --user"
    steps = [f"  {manager} daemon-reload", f"  {manager} enable --now {UNIT}"]
    if system:
        state = SYSTEM_STATE / ".local/share/embomatrix/worker"
        return [*steps, f"  sudo {' '.join(command)} worker status --state-dir={state}"]
    return [
        *steps,
        "  loginctl enable-linger    # to go on while you are logged out",
        "  embomatrix worker status",
    ]


def program() -> list[str]:
    """How this very installation is called, by absolute paths: a unit has no shell's PATH."""
    script = Path(sys.executable).with_name("embomatrix")
    if script.exists():
        return [str(script)]
    found = shutil.which("embomatrix")
    return [found] if found is not None else [sys.executable, "-m", "embomatrix.cli"]


def unit_text(command: Sequence[str], words: Sequence[str], *, system: bool) -> str:
    """The unit: started again when it dies, drained by SIGTERM, and behind everything else on the machine."""
    line = " ".join(quote(word) for word in [*command, "worker", "run", *words])
    own = ""
    if system:
        handed, credentials = handed_over(words)
        line = " ".join([*(quote(word) for word in [*command, "worker", "run"]), *handed])
        own = f"DynamicUser=yes\nStateDirectory={SYSTEM_STATE.name}\nStateDirectoryMode=0700\n"
        own += f"Environment=HOME={SYSTEM_STATE}\n" + "".join(f"{line}\n" for line in credentials)
    return f"""[Unit]
Description=EmboMatrix worker: lends this machine to a simulation manager
After=network-online.target
Wants=network-online.target

[Service]
ExecStart={line}
Restart=on-failure
RestartSec=10
# What a person must mend is not tried again.
RestartPreventExitStatus=2
KillMode=mixed
TimeoutStopSec={STOP_S}
CPUWeight=20
IOWeight=20
NoNewPrivileges=yes
{own}
[Install]
WantedBy={"multi-user.target" if system else "default.target"}
"""


def handed_over(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """The words as a unit without any rights may use them, and what systemd reads for it: files of mode 600 are root's."""
    handed, credentials = [], []
    for option, value in zip(["", *words], words, strict=False):
        if option not in FILES:
            handed.append(quote(value))
            continue
        sign, path = ("@", value[1:]) if option == "--token" else ("", value)
        name = option.removeprefix("--")
        credentials.append(f"LoadCredential={name}:{path.replace('%', '%%')}")
        handed.append(f"{sign}${{CREDENTIALS_DIRECTORY}}/{name}")
    return handed, credentials


def closed_to_others(path: Path) -> Path | None:
    """The first folder on the way to this file that only its owner may pass; None where everyone may."""
    return next(
        (folder for folder in reversed(path.parents) if not folder.stat().st_mode & stat.S_IXOTH), None
    )


def quote(word: str) -> str:
    """One word of a command line as systemd reads it: specifiers and variables are taken literally."""
    literal = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return literal if _PLAIN.fullmatch(word) else f'"{literal}"'


def _check(words: Sequence[str]) -> None:
    """End with a sentence about what would end the worker in the background, where nobody reads it."""
    for option, value in zip(words, [*words[1:], ""], strict=True):
        if option == "--join" or (option == "--token" and not value.startswith("@")):
            fail(
                "a token in a unit is for everyone to read: put it in a file of mode 600, "
                'as in `join = "TOKEN@HOST:PORT"`, and name that with --config'
            )
    settings_of(words)


def _check_for_all(words: Sequence[str], command: Sequence[str]) -> None:
    """What a unit of the whole machine can't use: it runs as a user of its own, who may write one folder."""
    settings = settings_of(words)
    if kept := settings.model_fields_set & {"cache_dir", "state_dir"}:
        option = f"--{sorted(kept)[0].replace('_', '-')}"
        fail(f"a unit of the whole machine writes below {SYSTEM_STATE} alone: leave {option} out")
    for path in (Path(command[0]), Path(sys.executable).resolve()):
        if closed := closed_to_others(path):
            fail(
                f"{path} is for its owner alone ({closed} lets nobody else in), and a unit of the whole machine runs "
                "as a user of its own: install EmboMatrix under /opt, or leave --system out"
            )
