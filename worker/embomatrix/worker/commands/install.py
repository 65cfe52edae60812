"""`embomatrix worker install`: a systemd unit that runs the worker permanently."""

import itertools
import re
import shutil
import stat
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console

from embomatrix.host.own_files import Force, is_own
from embomatrix.worker.commands.options import fail
from embomatrix.worker.commands.run import settings_of

UNIT: Final = "embomatrix-worker.service"
USER_UNITS: Final = Path("~/.config/systemd/user")
SYSTEM_UNITS: Final = Path("/etc/systemd/system")
SYSTEM_STATE: Final = Path("/var/lib/embomatrix-worker")
"""Only folder that a system unit may write. A manager has another, because each has a dedicated user."""
UNIT_MARK: Final = b"Description=EmboMatrix worker:"
"""Begin of the line by which a unit of this command is known."""
STOP_S: Final = 90
"""Longer than a drain, so that running rollouts may end."""
FILES: Final = frozenset({"--config", "--ca", "--token"})
"""Options that name an input file; ``--token`` by ``@FILE``."""
FOLDERS: Final = frozenset({"--cache-dir", "--state-dir"})
_PLAIN: Final = re.compile(r"[\w@%+=:,./-]+", re.ASCII)


def install(
    context: typer.Context,
    folder: Annotated[
        Path | None,
        typer.Option(help="Folder of the unit; by default the one of systemd.", show_default=False),
    ] = None,
    system: Annotated[
        bool, typer.Option("--system", help="Install for the whole machine, started at boot; needs root.")
    ] = False,
    force: Force = False,
) -> None:
    """Write a systemd unit that runs `embomatrix worker run` with the options that follow `--`."""
    if sys.platform != "linux":
        fail("units are for systemd on Linux: on this system start `embomatrix worker run` at log-in instead")
    words = absolute(split_options(context.args))
    command = program()
    _check(words)
    if system:
        _check_for_all(words, command)
    target = (folder or (SYSTEM_UNITS if system else USER_UNITS)).expanduser() / UNIT
    if not force and target.exists() and not is_own(target, UNIT_MARK):
        fail(
            f"{target} was not written by this command: name another folder with --folder, or pass --force to replace it"
        )
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(unit_text(command, words, system=system), encoding="utf-8")
    except OSError as error:
        fail(f"{target} can't be written ({error.strerror or error}): use --folder, or root for --system")
    console = Console(soft_wrap=True)
    for line in (f"wrote {target}; now run", *next_steps(command, system=system)):
        console.print(line, highlight=False, markup=False)


def split_options(arguments: Sequence[str]) -> list[str]:
    """Split ``--option=value`` into two words."""
    return [
        part
        for word in arguments
        for part in (word.split("=", 1) if word.startswith("--") and "=" in word else [word])
    ]


def absolute(words: Sequence[str]) -> list[str]:
    """Make paths absolute: a unit starts in another folder and does not expand ``~``."""
    resolved = list(words)
    for number, option in enumerate(words[:-1], start=1):
        value = words[number]
        if option == "--token" and value.startswith("@"):
            resolved[number] = f"@{Path(value[1:]).expanduser().absolute()}"
        elif option in FOLDERS or (option in FILES and option != "--token"):
            resolved[number] = str(Path(value).expanduser().absolute())
    return resolved


def next_steps(command: Sequence[str], *, system: bool) -> list[str]:
    """Commands to run after the unit was written."""
    manager = "sudo systemctl" if system else "systemctl --user"
    steps = [f"  {manager} daemon-reload", f"  {manager} enable --now {UNIT}"]
    if system:
        state = SYSTEM_STATE / ".local/share/embomatrix/worker"
        return [*steps, f"  sudo {' '.join(command)} worker status --state-dir={state}"]
    return [
        *steps,
        "  loginctl enable-linger    # to keep it running while you are logged out",
        "  embomatrix worker status",
    ]


def program() -> list[str]:
    """Command of this installation by absolute paths: a unit has no shell's PATH."""
    script = Path(sys.executable).with_name("embomatrix")
    if script.exists():
        return [str(script)]
    found = shutil.which("embomatrix")
    return [found] if found is not None else [sys.executable, "-m", "embomatrix.cli"]


def unit_text(command: Sequence[str], words: Sequence[str], *, system: bool) -> str:
    """Text of the unit: restarted after a crash, drained by SIGTERM, with low priority."""
    line = " ".join(quote(word) for word in [*command, "worker", "run", *words])
    system_lines = ""
    if system:
        passed, credentials = pass_credentials(words)
        line = " ".join([*(quote(word) for word in [*command, "worker", "run"]), *passed])
        system_lines = f"DynamicUser=yes\nStateDirectory={SYSTEM_STATE.name}\nStateDirectoryMode=0700\n"
        system_lines += f"Environment=HOME={SYSTEM_STATE}\n" + "".join(f"{line}\n" for line in credentials)
    return f"""[Unit]
{UNIT_MARK.decode()} lends this machine to a simulation manager
After=network-online.target
Wants=network-online.target

[Service]
ExecStart={line}
Restart=on-failure
RestartSec=10
# Status 2 needs a user: no restart.
RestartPreventExitStatus=2
KillMode=mixed
TimeoutStopSec={STOP_S}
CPUWeight=20
IOWeight=20
NoNewPrivileges=yes
{system_lines}
[Install]
WantedBy={"multi-user.target" if system else "default.target"}
"""


def pass_credentials(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the words for an unprivileged unit, and the credentials that systemd reads for it as root."""
    passed, credentials = [], []
    for option, value in zip(["", *words], words, strict=False):
        if option not in FILES:
            passed.append(quote(value))
            continue
        sign, path = ("@", value[1:]) if option == "--token" else ("", value)
        name = option.removeprefix("--")
        credentials.append(f"LoadCredential={name}:{path.replace('%', '%%')}")
        passed.append(f"{sign}${{CREDENTIALS_DIRECTORY}}/{name}")
    return passed, credentials


def closed_to_others(path: Path) -> Path | None:
    """First parent folder that other users can't enter; None if there is none."""
    return next(
        (folder for folder in reversed(path.parents) if not folder.stat().st_mode & stat.S_IXOTH), None
    )


def quote(word: str) -> str:
    """Quote one word for systemd, with specifiers and variables taken literally."""
    literal = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return literal if _PLAIN.fullmatch(word) else f'"{literal}"'


def _check(words: Sequence[str]) -> None:
    """Refuse options that would end the worker later, in the background."""
    for option, value in itertools.zip_longest(words, words[1:], fillvalue=""):
        if option == "--join" or (option == "--token" and not value.startswith("@")):
            fail(
                "every user can read a token in a unit: put it in a file of mode 600, "
                'as in `join = "TOKEN@HOST:PORT"`, and name that with --config'
            )
    settings_of(words)


def _check_for_all(words: Sequence[str], command: Sequence[str]) -> None:
    """Refuse options that a system unit can't use: it runs as a dedicated user who may write one folder."""
    settings = settings_of(words)
    if kept := settings.model_fields_set & {"cache_dir", "state_dir"}:
        option = f"--{sorted(kept)[0].replace('_', '-')}"
        fail(f"a system unit can write below {SYSTEM_STATE} only: leave {option} out")
    for path in (Path(command[0]), Path(sys.executable).resolve()):
        if closed := closed_to_others(path):
            fail(
                f"other users can't reach {path} ({closed} is closed to them), and a system unit runs "
                "as a dedicated user: install EmboMatrix under /opt, or leave --system out"
            )
