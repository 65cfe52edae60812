"""Throughput of the manager's state machines in decisions per second.

Usage: ``python tests/bench/bench_dispatcher.py [ROLLOUTS WORKERS]``. Every rollout is submitted, leased and finished;
workers are values, not processes. Prints one JSON object.
"""

import json
import sys
import time

from embomatrix.manager.control.cluster_state import ClusterState
from embomatrix.manager.control.commands import DeliverResult, GiveLease, SetDesired
from embomatrix.manager.control.events import (
    BatchSubmitted,
    LeaseFinished,
    Tick,
    WorkerJoined,
    WorkerReported,
)
from embomatrix.reward.breakdown import RewardBreakdown
from embomatrix.rpc.wire.values import (
    Batch,
    Completed,
    Resident,
    ResidentState,
    Resources,
    Rollout,
    Timings,
)

SCENES = 64
SLOTS = 16
DONE = Completed(RewardBreakdown(0.5, 0.0, 0.0, (), False), (), (), "", "", Timings(), True)


def main(rollouts: int, workers: int) -> None:
    cluster, now_s, given, delivered = ClusterState(lease_key=b"key"), 0.0, [], 0
    slowest_s = 0.0

    def apply(event):
        nonlocal now_s, delivered, slowest_s
        now_s += 1e-4
        begin = time.perf_counter()
        commands = cluster.handle(event, now_s=now_s)
        slowest_s = max(slowest_s, time.perf_counter() - begin)
        for command in commands:
            match command:
                case GiveLease():
                    given.append(command)
                case DeliverResult():
                    delivered += 1
                case SetDesired(worker_id, scenes):
                    warm = tuple(Resident(scene, ResidentState.WARM, 1.0, 50.0) for scene in scenes)
                    apply(WorkerReported(worker_id, warm))

    for index in range(workers):
        apply(WorkerJoined(f"w{index}", Resources(SLOTS, SLOTS, 2000)))
        apply(WorkerReported(f"w{index}", (), resync=True))
    plans = tuple(
        Rollout(f"x{i}", f"g{i // 16}", f"s{i // 16 % SCENES}", "t", (), 0) for i in range(rollouts)
    )
    begin = time.perf_counter()
    apply(BatchSubmitted(Batch("r", "b", 1, plans)))
    submitted_s, submit_slowest_s, slowest_s = time.perf_counter() - begin, slowest_s, 0.0
    begin = time.perf_counter()
    finished = 0
    while delivered < rollouts:
        if not given:
            # Nothing runs: the next placement comes with the clock.
            now_s += 0.1
            apply(Tick())
            continue
        lease = given.pop(0)
        apply(LeaseFinished(lease.worker_id, lease.ref, DONE))
        finished += 1
        if finished % 1000 == 0:
            apply(Tick())
    finish_s = time.perf_counter() - begin
    print(
        json.dumps(
            {
                "rollouts": rollouts,
                "workers": workers,
                "slots": workers * SLOTS,
                "submit_s": round(submitted_s, 4),
                "submit_slowest_event_s": round(submit_slowest_s, 4),
                "finish_and_lease_per_s": round(rollouts / finish_s),
                "slowest_event_s": round(slowest_s, 5),
            }
        )
    )


if __name__ == "__main__":
    main(*(map(int, sys.argv[1:3]) if len(sys.argv) > 2 else (16_000, 32)))
