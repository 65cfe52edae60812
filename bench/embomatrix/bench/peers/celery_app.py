"""The Celery application of the contest: ``celery -A embomatrix.bench.peers.celery_app worker``.

Tuned as its guide advises for work that must not be lost: a message is acknowledged after its task, and given back when the
process dies. No events, no rate limits. Messages are JSON, the default: with pickle a worker does not run as root.
"""

from __future__ import annotations

import os
from typing import Final

from celery import Celery

from embomatrix.bench.peers.engine_pool import execute_fresh, execute_held

BROKER: Final = "EMBOMATRIX_BENCH_BROKER"
"""Environment variable that names the broker to the worker."""
FRESH: Final = "fresh"
HELD: Final = "held"


def application(broker: str | None) -> Celery:
    """The tasks of the contest on this broker, which keeps the results as well."""
    made = Celery("bench", broker=broker, backend=broker)
    made.conf.update(
        worker_disable_rate_limits=True,
        worker_hijack_root_logger=False,
        broker_connection_retry_on_startup=True,
    )
    made.task(name=FRESH)(execute_fresh)
    made.task(name=HELD, acks_late=True, reject_on_worker_lost=True)(execute_held)
    return made


app = application(os.environ.get(BROKER))
