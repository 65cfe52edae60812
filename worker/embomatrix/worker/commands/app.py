"""`embomatrix worker`: run a worker on this machine, or check whether the machine is fit."""

import asyncio
import platform
import tempfile
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from embomatrix.host.commands import command_group
from embomatrix.worker.commands.install import install
from embomatrix.worker.commands.options import check_engine, fail, parse
from embomatrix.worker.commands.ray import ray_workers
from embomatrix.worker.commands.run import run
from embomatrix.worker.commands.status import status
from embomatrix.worker.host.resources import measure
from embomatrix.worker.slots.processes import ProcessGoneError, start_root

app = command_group(help="Run a worker that lends this machine's cores to a manager.")
console = Console()

app.command()(run)
app.command()(status)
app.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})(install)
app.command("ray", context_settings={"ignore_unknown_options": True, "allow_extra_args": True})(ray_workers)


@app.command()
def doctor() -> None:
    """Report the resources of this machine and start the simulator. `embomatrix doctor` checks the connection."""
    check_engine()
    resources = measure(parse({}))
    table = Table(box=None, show_header=False, padding=(0, 2))
    table.add_row("python", f"{platform.python_version()} on {platform.machine()}")
    table.add_row("engine", f"pybullet {resources.versions['pybullet']}")
    table.add_row("platform", resources.versions["platform"])
    table.add_row("slots", f"{resources.slots} (cores)")
    table.add_row("free for bundles", f"{resources.disk_mb} MB")
    table.add_row("memory for scenes", f"{resources.memory_mb} MB")
    table.add_row("speed", f"{resources.score:.2f} of the reference")
    table.add_row("gpu", f"{resources.gpu}, {resources.vram_mb} MB" if resources.gpu else "none (not needed)")
    try:
        started_s, memory_mb = asyncio.run(_start_simulator())
    except ProcessGoneError as error:
        console.print(table)
        fail(str(error))
    table.add_row("simulator", f"starts in {started_s:.1f} s, {memory_mb:.0f} MB")
    console.print(table)


async def _start_simulator() -> tuple[float, float]:
    started_s = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        root = await start_root(Path(folder) / "simulator.log")
        elapsed_s = time.monotonic() - started_s
        await root.end()
    return elapsed_s, root.memory_mb
