"""The `embomatrix` command.

Subcommands are entry points of the group ``embomatrix.commands``: `--help` lists them without importing any package, and a
command whose packages are missing names the extra to install.
"""

import contextlib
import itertools
import os
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint, entry_points
from typing import Final

import typer
from rich.console import Console
from rich.table import Table

from embomatrix.host.failure import fail, shown

GROUP: Final = "embomatrix.commands"


@dataclass(frozen=True, slots=True)
class Command:
    """Help text of a subcommand, and the extra that installs its packages.

    ``optional``: packages that some options need beyond these, with the extra that installs each.
    """

    panel: str
    summary: str
    extra: str
    optional: Mapping[str, str] = field(default_factory=dict)


COMMANDS: Final[dict[str, Command]] = {
    "demo": Command("Start here", "start a local cluster and train on it, as `make run` does", "all"),
    "doctor": Command("Start here", "check this machine and the connection to a manager", "worker"),
    "manager": Command("Cluster", "serve a Simulation Manager, and manage its tokens", "manager"),
    "worker": Command("Cluster", "run a worker on this machine", "worker"),
    "status": Command("Cluster", "describe a cluster in a few sentences", "manager"),
    "top": Command("Cluster", "watch a cluster live", "manager"),
    "cluster": Command("Cluster", "inspect and control workers and runs; reports and traces", "report"),
    "factory": Command("Tasks and scenes", "build a dataset of verified tasks, import BDDL", "factory"),
    "scene": Command("Tasks and scenes", "build, check and draw base scenes", "factory"),
    "play": Command(
        "Tasks and scenes",
        "execute a plan in a task; explain each step and the reward",
        "physics",
        {"torch": "trainer", "PIL": "factory"},
    ),
    "imitate": Command(
        "Training and evaluation",
        "warm up a policy on oracle plans, without a cluster",
        "trainer",
        {"scipy": "physics"},
    ),
    "train": Command(
        "Training and evaluation",
        "train a policy with imitation and GRPO on a cluster",
        "trainer",
        {"scipy": "physics"},
    ),
    "eval": Command(
        "Training and evaluation",
        "measure a model, an endpoint or a baseline",
        "trainer",
        {"scipy": "physics"},
    ),
    "eai": Command("Training and evaluation", "install and run the judge of the EAI benchmark", "trainer"),
    "model": Command(
        "Training and evaluation", "import a packaged language model", "hf", {"scipy": "physics"}
    ),
    "experiment": Command("Measurements", "repeat the paper's experiments: curves, tables, times", "all"),
    "bench": Command("Measurements", "measure rollouts and the cluster on this machine", "bench"),
}


def main() -> None:
    """Entry point of the console script."""
    # grpc reads this at import. Its warnings only repeat our own messages.
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
    """Show a missing package, at import or at first use, as a message that names the extra to install."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "embomatrix").startswith("embomatrix"):
            raise
        package = str(error.name).split(".")[0]
        command = COMMANDS.get(name)
        extra = command.optional.get(package, command.extra) if command is not None else "all"
        fail(
            name,
            f"the package {package!r} is not installed: install it with `pip install 'embomatrix[{extra}]'`",
        )


def _load(point: EntryPoint) -> Callable[..., object]:
    """Import a command; return it as a callable on an argument list."""
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
    installed = {point.name for point in entry_points(group=GROUP)}
    others = {name: Command("Other", "", "all") for name in sorted(installed - set(COMMANDS))}
    found = {name: command for name, command in (COMMANDS | others).items() if name in installed}
    for panel, names in itertools.groupby(found, key=lambda name: found[name].panel):
        table = Table(box=None, show_header=False, padding=(0, 2))
        table.add_column(no_wrap=True, width=10)
        for name in names:
            table.add_row(f"[bold]{name}[/bold]", found[name].summary)
        console.print(panel, highlight=False)
        console.print(table)
    console.print("\n`embomatrix COMMAND --help` explains each.", highlight=False)
