"""Findings about a machine: Python, packages, ports, memory and disk."""

import errno
import importlib.util
import os
import platform
import shutil
import socket
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Final

NEEDED: Final[Mapping[str, tuple[str, ...]]] = {
    "worker": ("pybullet", "scipy", "psutil"),
    "manager": (
        "fastapi",
        "starlette",
        "uvicorn",
        "redis",
        "prometheus_client",
        "cryptography",
        "grpc_health",
        "grpc_reflection",
    ),
    "factory": ("pybullet", "scipy", "trimesh", "PIL", "inflect", "httpx"),
    "trainer": ("torch", "matplotlib", "httpx"),
}
"""Packages of each part, by the extra that installs them."""
PORTS: Final[Mapping[str, int]] = {"port of workers and trainers": 50070, "port of the status page": 8070}
MEMORY_LEAST_MB: Final = 512
"""A simulator takes 100 MB, a scene 20 to 80 MB, an empty manager 90 MB."""
MEMORY_GOOD_MB: Final = 2048
DISK_LEAST_MB: Final = 200
DISK_GOOD_MB: Final = 2048
"""A worker's bundle cache may take 1 GiB; a manager's bundles may take more."""
MEGABYTE: Final = 1_000_000


class Level(StrEnum):
    """Severity of a finding."""

    FINE = "fine"
    NOTE = "note"
    """Some part cannot be used here, or may run short of a resource."""
    WRONG = "wrong"


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check; ``remedy`` is empty if nothing needs to be done."""

    thing: str
    level: Level
    found: str
    remedy: str = ""


def verdict(findings: Sequence[Finding]) -> str:
    """Summarise the findings in one sentence."""
    wrong = [finding.thing for finding in findings if finding.level is Level.WRONG]
    if wrong:
        return f"{len(wrong)} of {len(findings)} things {_are(len(wrong))} wrong: {', '.join(wrong)}"
    notes = sum(finding.level is Level.NOTE for finding in findings)
    return (
        "all is well"
        if not notes
        else f"nothing is wrong; {notes} of {len(findings)} things {_are(notes)} worth a look"
    )


def _are(number: int) -> str:
    return "is" if number == 1 else "are"


def machine(managers: Collection[int] = ()) -> list[Finding]:
    """Check this machine. ``managers`` are its ports at which a manager answered."""
    installed = {name for names in NEEDED.values() for name in names if importlib.util.find_spec(name)}
    free_ports = {name: _is_free(port) for name, port in PORTS.items()}
    return [
        python(sys.version_info[:2], platform.system(), platform.machine()),
        *parts(installed),
        *(
            port(name, PORTS[name], free=free, ours=PORTS[name] in managers)
            for name, free in free_ports.items()
        ),
        memory(_free_memory_mb()),
        disk(Path.home(), shutil.disk_usage(Path.home()).free / MEGABYTE),
    ]


def python(version: tuple[int, int], system: str, processor: str) -> Finding:
    """Judge the Python version and platform."""
    found = f"{version[0]}.{version[1]} on {system}, {processor}"
    if version < (3, 11):
        return Finding("Python", Level.WRONG, found, "install Python 3.11")
    if version >= (3, 12) or system != "Linux" or processor not in ("x86_64", "AMD64"):
        advice = "a manager and a trainer run here; the physics engine of workers and of the factory has wheels for Python "
        return Finding("Python", Level.NOTE, found, f"{advice}3.11 on x86-64 Linux alone")
    return Finding("Python", Level.FINE, found)


def parts(installed: Collection[str]) -> list[Finding]:
    """Judge for each part whether its packages are installed."""
    findings: list[Finding] = []
    for extra, names in NEEDED.items():
        missing = [name for name in names if name not in installed]
        if missing:
            remedy = f"to run it here: pip install 'embomatrix[{extra}]'"
            findings.append(Finding(extra, Level.NOTE, f"lacks {', '.join(missing)}", remedy))
        else:
            findings.append(Finding(extra, Level.FINE, "installed"))
    return findings


def port(name: str, number: int, *, free: bool, ours: bool = False) -> Finding:
    """Judge a default port of the manager; ``ours`` if a manager answers there."""
    if free:
        return Finding(name, Level.FINE, f"{number} is free")
    if ours:
        return Finding(name, Level.FINE, f"{number} is used by this machine's manager")
    remedy = "another program uses it: start a manager with --port and --http-port"
    return Finding(name, Level.NOTE, f"{number} is taken", remedy)


def memory(free_mb: float) -> Finding:
    """Judge the free memory."""
    return _amount(
        "memory", free_mb, MEMORY_LEAST_MB, MEMORY_GOOD_MB, "close programs, or give it fewer --slots"
    )


def disk(folder: Path, free_mb: float) -> Finding:
    """Judge the free disk space of the default folder for caches and state."""
    remedy = "make room, or pass --cache-dir and --data-dir of another disk"
    return _amount(f"disk of {folder}", free_mb, DISK_LEAST_MB, DISK_GOOD_MB, remedy)


def _amount(thing: str, free_mb: float, least_mb: float, good_mb: float, remedy: str) -> Finding:
    found = f"{free_mb:,.0f} MB are free"
    if free_mb >= good_mb:
        return Finding(thing, Level.FINE, found)
    level = Level.NOTE if free_mb >= least_mb else Level.WRONG
    return Finding(thing, level, f"{found}, {good_mb:,.0f} would do", remedy)


def _is_free(number: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", number))
        except OSError as error:
            return error.errno != errno.EADDRINUSE
    return True


def _free_memory_mb() -> float:
    """Return the memory available without swapping; where the kernel does not say, the total memory."""
    table = Path("/proc/meminfo")
    if table.exists():
        for line in table.read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024 / MEGABYTE
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / MEGABYTE
