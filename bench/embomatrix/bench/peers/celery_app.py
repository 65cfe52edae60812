"""Celery application of the contest, run as ``celery -A embomatrix.bench.peers.celery_app worker``.

It is tuned as Celery's guide advises for work that must not be lost: a message is acknowledged after its task and given back if
the process dies. Messages are JSON, the default, because a worker with pickle does not run as root.
"""

import os
from typing import Final

from celery import Celery

from embomatrix.bench.peers.scene_process import execute_chunk

BROKER: Final = "EMBOMATRIX_BENCH_BROKER"
"""Environment variable that names the broker to the worker."""


def application(broker: str | None) -> Celery:
    """Register the task on this broker, which keeps the results as well."""
    made = Celery("bench", broker=broker, backend=broker)
    made.conf.update(
        worker_disable_rate_limits=True,
        worker_hijack_root_logger=False,
        broker_connection_retry_on_startup=True,
    )
    made.task(name=execute_chunk.__name__, acks_late=True, reject_on_worker_lost=True)(execute_chunk)
    return made


app = application(os.environ.get(BROKER))
