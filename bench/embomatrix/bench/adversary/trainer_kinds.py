"""Kinds of messages that a hostile trainer sends with its own token."""

import zlib
from collections.abc import Callable, Sequence
from typing import Final

from embomatrix.bench.adversary.kinds import (
    LARGE_BYTES,
    SLOW,
    AttackerRole,
    Knowledge,
    hostile,
    unknown_field,
)
from embomatrix.bench.adversary.messages import NUMBERS, MessageMaker
from embomatrix.proto.v1 import rollout_service_pb2 as pb
from embomatrix.proto.v1 import scene_service_pb2, types_pb2
from embomatrix.rpc.versions import PROTOCOL_VERSION
from embomatrix.world.inflation import bundle_digest

OPEN_RUN: Final = "RolloutService/OpenRun"
EXECUTE: Final = "RolloutService/Execute"
PUT_BUNDLE: Final = "SceneService/PutBundle"
BOMB_BYTES: Final = 50_000_000
"""Decompressed size of the bomb; it travels as 50 kB."""

Damage = Callable[[pb.ExecuteRequest, MessageMaker], None]


def _open_kind(name: str) -> Callable[[Callable[..., None]], Callable[..., None]]:
    def enter(damage: Callable[[pb.OpenRunRequest, MessageMaker], None]) -> Callable[..., None]:
        @hostile(name, AttackerRole.TRAINER, OPEN_RUN, 0.3)
        def make(known: Knowledge, maker: MessageMaker) -> Sequence[pb.OpenRunRequest]:
            request = pb.OpenRunRequest(
                name="hostile", run_id=known.run_id, protocol_version=PROTOCOL_VERSION
            )
            damage(request, maker)
            return [request]

        return damage

    return enter


def _execute_kind(name: str) -> Callable[[Damage], Damage]:
    """Decorator: the function damages a sound batch of two rollouts in the attacker's own run."""

    def enter(damage: Damage) -> Damage:
        @hostile(name, AttackerRole.TRAINER, EXECUTE)
        def make(known: Knowledge, maker: MessageMaker) -> Sequence[pb.ExecuteRequest]:
            known.batches += 1
            request = pb.ExecuteRequest(run_id=known.run_id, batch_id=f"{known.run_id}-{known.batches}")
            for number, rollout in enumerate(maker.rng.sample(list(known.rollouts), 2)):
                added = request.rollouts.add()
                added.CopyFrom(rollout)
                added.rollout_id = f"{request.batch_id}-{number}"
            damage(request, maker)
            return [request]

        return damage

    return enter


@_open_kind("run name with a forged log line")
def _newline(request: pb.OpenRunRequest, maker: MessageMaker) -> None:
    del maker
    request.name = "a run\n2031-01-01 00:00:00 ERROR embomatrix.manager worker quarantined worker=honest-1"


@_open_kind("run name with markup")
def _markup(request: pb.OpenRunRequest, maker: MessageMaker) -> None:
    request.name = maker.rng.choice(("[/bold]", "[link=file:///]x", "<img src=x onerror=alert(1)>"))


@_open_kind("run name with escape sequences")
def _escape(request: pb.OpenRunRequest, maker: MessageMaker) -> None:
    del maker
    request.name = "\x1b]0;owned\x07\x1b[2J"


@_open_kind("run with any weight")
def _weight(request: pb.OpenRunRequest, maker: MessageMaker) -> None:
    request.run_id = f"{request.run_id}-{maker.rng.randrange(8)}"
    request.weight, request.rollout_deadline_s = maker.number(), maker.number()
    request.priority = maker.rng.choice((-(2**31), 0, 2**31 - 1))


@_open_kind("weights far apart")
def _weights(request: pb.OpenRunRequest, maker: MessageMaker) -> None:
    request.run_id = f"{request.run_id}-{maker.rng.randrange(8)}"
    request.weight = maker.rng.choice((5e-324, 1e-300, 1e-3, 1e6))


@_open_kind("run with any coefficients")
def _coefficients(request: pb.OpenRunRequest, maker: MessageMaker) -> None:
    request.run_id = f"{request.run_id}-{maker.rng.randrange(8)}"
    request.reward.CopyFrom(maker.any(types_pb2.RewardSettings))


@_execute_kind("sound batch")
def _sound(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    del request, maker


@_execute_kind("unknown task")
def _unknown_task(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    request.rollouts[0].task_id = maker.text()


@_execute_kind("plan without calls")
def _empty_plan(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    del maker
    del request.rollouts[0].plan[:]


@_execute_kind("plan of 65 calls")
def _long_plan(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    del maker
    plan = request.rollouts[0].plan
    plan.extend([plan[0]] * (65 - len(plan)))


@_execute_kind("skill outside the profile")
def _other_skill(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    del request.rollouts[0].plan[:]
    request.rollouts[0].plan.add(
        skill=maker.rng.choice((0, 14, 15, 16, 99)),
        object_index=1,
    )


@_execute_kind("call with any arguments")
def _any_call(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    request.rollouts[0].plan[0].CopyFrom(maker.any(types_pb2.SkillCall))


@_execute_kind("call with 30 kB of unknown fields")
def _padded_call(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    request.rollouts[0].plan[0].MergeFromString(unknown_field(maker))


@_execute_kind("turn by NaN")
def _turn(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    del request.rollouts[0].plan[:]
    request.rollouts[0].plan.add(skill=types_pb2.SKILL_KIND_TURN, yaw=maker.rng.choice(NUMBERS))


@_execute_kind("room name of 100 kB")
def _room(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    del maker
    request.rollouts[0].plan.add(skill=types_pb2.SKILL_KIND_GO_TO_ROOM, room_name="x" * 100_000)


@_execute_kind("bundle that was not uploaded")
def _no_bundle(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    request.rollouts[0].bundle_digest = maker.text()


@_execute_kind("rollout id twice")
def _same_ids(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    del maker
    request.rollouts[1].rollout_id = request.rollouts[0].rollout_id


@_execute_kind("ids with line breaks")
def _bad_ids(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    request.batch_id = maker.text()
    request.rollouts[0].rollout_id, request.rollouts[0].group_id = maker.text(), maker.text()


@_execute_kind("batch id with other content")
def _same_batch(request: pb.ExecuteRequest, maker: MessageMaker) -> None:
    request.batch_id = "one"
    request.step = maker.count()


@hostile("cursor beyond the end", AttackerRole.TRAINER, "RolloutService/WaitExecution")
def _cursor(known: Knowledge, maker: MessageMaker) -> Sequence[pb.WaitExecutionRequest]:
    batch = f"{known.run_id}-{maker.rng.randint(0, known.batches + 1)}"
    return [pb.WaitExecutionRequest(run_id=known.run_id, batch_id=batch, after_cursor=maker.count())]


@hostile("look-ahead of any entries", AttackerRole.TRAINER, "RolloutService/AnnounceLookahead")
def _lookahead(known: Knowledge, maker: MessageMaker) -> Sequence[pb.AnnounceLookaheadRequest]:
    request = maker.any(pb.AnnounceLookaheadRequest)
    request.run_id = known.run_id
    return [request]


@hostile(
    "look-ahead of 4,000 scenes for GPUs", AttackerRole.TRAINER, "RolloutService/AnnounceLookahead", SLOW
)
def _many_scenes(known: Knowledge, maker: MessageMaker) -> Sequence[pb.AnnounceLookaheadRequest]:
    scenes = (f"sha256:{maker.rng.getrandbits(256):064x}" for _ in range(4_000))
    entries = [pb.LookaheadEntry(step=1, bundle_digest=scene, count=1, render=True) for scene in scenes]
    return [
        pb.AnnounceLookaheadRequest(run_id=known.run_id, version=maker.rng.getrandbits(62), entries=entries)
    ]


@hostile("batch of 24 MB", AttackerRole.TRAINER, EXECUTE, SLOW)
def _large_batch(known: Knowledge, maker: MessageMaker) -> Sequence[bytes]:
    del known
    return [maker.rng.randbytes(LARGE_BYTES)]


@hostile("training figures of NaN", AttackerRole.TRAINER, "RolloutService/ReportTraining")
def _report(known: Knowledge, maker: MessageMaker) -> Sequence[pb.ReportTrainingRequest]:
    request = maker.any(pb.ReportTrainingRequest)
    request.run_id, request.phase = known.run_id, "grpo"
    request.figures["reward"] = maker.number()
    return [request]


def _chunks(digest: str, data: bytes) -> list[scene_service_pb2.PutBundleRequest]:
    first = scene_service_pb2.PutBundleRequest(bundle_digest=digest)
    size = 1 << 20
    rest = [
        scene_service_pb2.PutBundleRequest(chunk=data[at : at + size]) for at in range(0, len(data), size)
    ]
    return [first, *rest]


_BOMB: Final = zlib.compress(bytes(BOMB_BYTES), 9)


@hostile("decompression bomb", AttackerRole.TRAINER, PUT_BUNDLE, 0.2)
def _bomb(known: Knowledge, maker: MessageMaker) -> Sequence[scene_service_pb2.PutBundleRequest]:
    del known, maker
    return _chunks(bundle_digest(_BOMB), _BOMB)


@hostile("bundle under a false digest", AttackerRole.TRAINER, PUT_BUNDLE)
def _false_digest(known: Knowledge, maker: MessageMaker) -> Sequence[scene_service_pb2.PutBundleRequest]:
    digest = maker.rng.choice(known.rollouts).bundle_digest
    return _chunks(maker.rng.choice((digest, maker.text(), "sha256:" + "e" * 64)), maker.rng.randbytes(999))


@hostile("bundle of 20 MB", AttackerRole.TRAINER, PUT_BUNDLE, SLOW)
def _large_bundle(known: Knowledge, maker: MessageMaker) -> Sequence[scene_service_pb2.PutBundleRequest]:
    del known
    return _chunks("sha256:" + "d" * 64, maker.rng.randbytes(20_000_000))


@hostile("bundle outside the folder", AttackerRole.TRAINER, "SceneService/GetBundle")
def _traversal(known: Knowledge, maker: MessageMaker) -> Sequence[scene_service_pb2.GetBundleRequest]:
    del known
    path = maker.rng.choice(("../state.sqlite", "../../access/ca.key", "/etc/passwd", "sha256:../x"))
    return [scene_service_pb2.GetBundleRequest(bundle_digest=path)]
