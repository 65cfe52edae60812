"""`embomatrix worker`: run workers on this machine."""

from embomatrix.host.commands import command_group
from embomatrix.worker.commands.install import install
from embomatrix.worker.commands.ray import ray_workers
from embomatrix.worker.commands.run import run
from embomatrix.worker.commands.status import status

app = command_group(help="Run a worker that lends this machine's cores to a manager.")

app.command()(run)
app.command()(status)
app.command(context_settings={"ignore_unknown_options": True, "allow_extra_args": True})(install)
app.command("ray", context_settings={"ignore_unknown_options": True, "allow_extra_args": True})(ray_workers)
