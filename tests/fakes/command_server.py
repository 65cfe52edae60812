"""Fork server for the `embomatrix` command, which saves the seconds that imports take.

The server has imported the commands' modules and forks one process for each command. Each command has its own
arguments, environment and standard streams. ``python -m tests.fakes.command_server FD`` serves on a socket.
"""

import contextlib
import gc
import importlib
import json
import os
import runpy
import signal
import socket
import struct
import sys
import traceback

IMPORTED = (
    "torch",
    "trimesh",
    "scipy.spatial",
    "pybullet",
    "embomatrix.factory.commands.app",
    "embomatrix.factory.commands.scenes",
    "embomatrix.cli.play",
    "embomatrix.trainer.run.loop",
    "embomatrix.trainer.commands.train",
    "embomatrix.manager.commands.app",
    "embomatrix.manager.services.app",
    "embomatrix.worker.commands.app",
    "embomatrix.worker.commands.run",
    "embomatrix.cli.cluster.app",
    "embomatrix.cli.demo",
)
STATUS = struct.Struct("i")
LONGEST = 1 << 20


def ask(server, arguments, environment, streams):
    """Start a command; returns a file that receives its exit status. ``streams`` are descriptors 0 to 2."""
    reading, writing = os.pipe()
    with contextlib.closing(os.fdopen(writing, "wb")):
        message = json.dumps([list(arguments), dict(environment), os.getcwd()]).encode()
        socket.send_fds(server, [message], [*streams, writing])
    return os.fdopen(reading, "rb")


def serve(server):
    """Fork for each request. Returns only in a forked process, which then becomes the command."""
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for the watching process
    while True:
        message, fds, _, _ = socket.recv_fds(server, LONGEST, 4)
        if not message:
            os._exit(0)
        if os.fork() == 0:
            server.close()
            watch(fds)
            return json.loads(message)
        for fd in fds:
            os.close(fd)


def watch(fds):
    """Fork once more to become the command, and send its exit status to the caller."""
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    *streams, writing = fds
    child = os.fork()
    if child == 0:
        os.close(writing)
        for number, fd in enumerate(streams):
            os.dup2(fd, number)
            os.close(fd)
        return
    for fd in streams:
        os.close(fd)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    os.write(writing, STATUS.pack(code))
    os._exit(0)


def main():
    for module in IMPORTED:
        with contextlib.suppress(ImportError):  # what an install lacks, its commands say
            importlib.import_module(module)
    gc.freeze()  # a collection in a fork would copy what all of them share
    arguments, environment, folder = serve(socket.socket(fileno=int(sys.argv[1])))
    os.environ.clear()
    os.environ.update(environment)
    os.chdir(folder)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = ["embomatrix", *arguments]
    os._exit(run_to_its_end())


def run_to_its_end():
    """Run the command and return its exit status. Skips the interpreter's teardown, which is slow."""
    status = 0
    try:
        runpy.run_module("embomatrix.cli", run_name="__main__", alter_sys=True)
    except SystemExit as leaving:
        if isinstance(leaving.code, str):
            print(leaving.code, file=sys.stderr)
        status = leaving.code if isinstance(leaving.code, int) else int(leaving.code is not None)
    except BaseException:  # noqa: BLE001  # an interpreter prints the error and exits
        traceback.print_exc()
        status = 1
    sys.stdout.flush()
    sys.stderr.flush()
    return status


if __name__ == "__main__":
    main()
