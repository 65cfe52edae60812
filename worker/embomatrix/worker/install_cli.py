"""`embomatrix worker install`: a systemd unit that runs the worker whenever this machine runs."""

from __future__ import annotations

import re
import shutil
import sys
from pathlib import Path
from typing import Annotated, Final

import typer
from rich.console import Console

from embomatrix.worker.settings_cli import fail

UNIT: Final = "embomatrix-worker.service"
USER_UNITS: Final = Path("~/.config/systemd/user")
SYSTEM_UNITS: Final = Path("/etc/systemd/system")
STOP_S: Final = 90
"""Longer than a drain takes, so that running rollouts may end."""
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
    arguments = context.args
    if any(word.startswith(("--token=", "--join=")) or word in {"--token", "--join"} for word in arguments):
        fail(
            "a token in a unit is for everyone to read: put it in a file of mode 600, "
            'as in `join = "TOKEN@HOST:PORT"`, and name that with --config'
        )
    target = (folder or (SYSTEM_UNITS if system else USER_UNITS)).expanduser() / UNIT
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(unit_text(program(), arguments, system=system), encoding="utf-8")
    except OSError as error:
        fail(f"{target} can't be written ({error.strerror or error}): use --folder, or root for --system")
    manager = "sudo systemctl" if system else "systemctl --user"
    console = Console(soft_wrap=True)
    for line in (
        f"wrote {target}; now run",
        f"  {manager} daemon-reload",
        f"  {manager} enable --now {UNIT}",
        *([] if system else ["  loginctl enable-linger    # to go on while you are logged out"]),
        "  embomatrix worker status",
    ):
        console.print(line, highlight=False, markup=False)


def program() -> list[str]:
    """How this very installation is called, by absolute paths: a unit has no shell's PATH."""
    script = Path(sys.executable).with_name("embomatrix")
    if script.exists():
        return [str(script)]
    found = shutil.which("embomatrix")
    return [found] if found is not None else [sys.executable, "-m", "embomatrix.cli"]


def unit_text(command: list[str], arguments: list[str], *, system: bool) -> str:
    """The unit: started again when it dies, drained by SIGTERM, and behind everything else on the machine."""
    line = " ".join(quote(word) for word in [*command, "worker", "run", *arguments])
    user = (
        "DynamicUser=yes\nStateDirectory=embomatrix\nEnvironment=HOME=/var/lib/embomatrix\n" if system else ""
    )
    return f"""[Unit]
Description=Embomatrix worker: lends this machine to a simulation manager
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
{user}
[Install]
WantedBy={"multi-user.target" if system else "default.target"}
"""


def quote(word: str) -> str:
    """One word of a command line as systemd reads it: specifiers and variables are taken literally."""
    literal = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return literal if _PLAIN.fullmatch(word) else f'"{literal}"'
