"""Kinds of messages that a hostile worker sends with its own credential."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Final

from embomatrix.bench.adversary.kinds import SLOW, AttackerRole, Knowledge, hostile, unknown_field
from embomatrix.bench.adversary.messages import MessageMaker
from embomatrix.proto.v1 import types_pb2
from embomatrix.proto.v1 import worker_service_pb2 as pb
from embomatrix.reward.settings import PAPER
from embomatrix.rpc.versions import PROTOCOL_VERSION

SESSION: Final = "WorkerService/Session"
REGISTER: Final = "WorkerService/Register"
HEARTBEAT: Final = "WorkerService/Heartbeat"
MANY_RESIDENTS: Final = 20_000
MANY_LABELS: Final = 2_000_000
"""Bytes of one label."""

StateOf = Callable[[Knowledge, MessageMaker], pb.WorkerState]
ResultOf = Callable[[pb.LeaseResult, MessageMaker], None]


def _request(known: Knowledge, **parts: object) -> pb.SessionRequest:
    return pb.SessionRequest(session_id=known.session_id, session_epoch=known.epoch, **parts)  # type: ignore[arg-type]


def _own_state(known: Knowledge) -> pb.WorkerState:
    """Return the state of a sound worker: every scene warm, every lease running."""
    digests = sorted({rollout.bundle_digest for rollout in known.rollouts})
    residents = [
        pb.Resident(bundle_digest=digest, state=pb.RESIDENT_STATE_WARM, load_s=0.01, memory_mb=1.0)
        for digest in digests
    ]
    return pb.WorkerState(residents=residents, running=[lease.ref for lease in known.leases])


def first_state(known: Knowledge) -> pb.SessionRequest:
    """Return the message that opens a session."""
    return _request(known, state=_own_state(known))


def lie(lease: pb.Lease, held: int = 1, atoms: int = 2) -> pb.LeaseResult:
    """Return a made-up result without a contradiction: every step succeeded, and ``held`` of the atoms hold."""
    result = pb.LeaseResult(lease=lease.ref, slot=1, held_s=0.001)
    done = result.completed
    done.reward.format, done.reward.goal = PAPER.format, PAPER.goal * held / atoms
    for number in range(atoms):
        done.reward.atoms.add(text=f"(ontop thing_{number} countertop_1)", holds=number < held)
    for call in lease.rollout.plan:
        done.steps.add(call=call, message="the step is done")
    done.trace_digest = "sha256:" + "1" * 64
    done.timings.execute_s = 0.001
    return result


def _random_lie(known: Knowledge, maker: MessageMaker) -> pb.LeaseResult:
    """Return a lie that a second liar hardly ever repeats, since two equal lies would outvote an honest worker."""
    atoms = maker.rng.randint(50, 90)
    return lie(_lease(known, maker), maker.rng.randrange(atoms), atoms)


def _lease(known: Knowledge, maker: MessageMaker) -> pb.Lease:
    """Return a lease that the worker got, else an invented one."""
    if known.leases:
        return maker.rng.choice(known.leases)
    rollout = maker.rng.choice(known.rollouts)
    return pb.Lease(
        ref=pb.LeaseRef(lease_id="boot-1", lease_epoch=1), rollout=rollout, origin=_origin(known, maker)
    )


def _origin(known: Knowledge, maker: MessageMaker) -> pb.LeaseOrigin:
    rollout = maker.rng.choice(known.rollouts)
    return pb.LeaseOrigin(run_id=known.run_id, batch_id="1", rollout_id=rollout.rollout_id, attempt=1)


def _result_kind(name: str) -> Callable[[ResultOf], ResultOf]:
    """Decorator: the function damages a well-formed result of a lease that the worker holds."""

    def enter(damage: ResultOf) -> ResultOf:
        @hostile(name, AttackerRole.WORKER, SESSION)
        def make(known: Knowledge, maker: MessageMaker) -> Sequence[pb.SessionRequest]:
            result = _random_lie(known, maker)
            damage(result, maker)
            return [_request(known, results=[result])]

        return damage

    return enter


def _state_kind(name: str, weight: float = 1.0) -> Callable[[StateOf], StateOf]:
    def enter(state_of: StateOf) -> StateOf:
        @hostile(name, AttackerRole.WORKER, SESSION, weight)
        def make(known: Knowledge, maker: MessageMaker) -> Sequence[pb.SessionRequest]:
            return [_request(known, state=state_of(known, maker))]

        return state_of

    return enter


# Results


@_result_kind("made-up result")
def _made_up(result: pb.LeaseResult, maker: MessageMaker) -> None:
    del result, maker


@_result_kind("reward of NaN or infinity")
def _not_finite(result: pb.LeaseResult, maker: MessageMaker) -> None:
    result.completed.reward.goal = maker.rng.choice((math.nan, math.inf, -math.inf))


@_result_kind("reward of 1.7e308")
def _huge_reward(result: pb.LeaseResult, maker: MessageMaker) -> None:
    result.completed.reward.relevance = maker.rng.choice((1.7e308, -1.7e308, -1e9))


@_result_kind("success without atoms")
def _no_atoms(result: pb.LeaseResult, maker: MessageMaker) -> None:
    del maker
    del result.completed.reward.atoms[:]


@_result_kind("500 steps for a plan")
def _many_steps(result: pb.LeaseResult, maker: MessageMaker) -> None:
    del maker
    step = types_pb2.StepResult(call=types_pb2.SkillCall(skill=types_pb2.SKILL_KIND_MOVE, object_index=1))
    result.completed.steps.extend([step] * 500)


@_result_kind("no steps for a plan")
def _no_steps(result: pb.LeaseResult, maker: MessageMaker) -> None:
    del maker
    del result.completed.steps[:]


@_result_kind("result without an outcome")
def _no_outcome(result: pb.LeaseResult, maker: MessageMaker) -> None:
    del maker
    result.ClearField("completed")


@_result_kind("unknown reason of a failed step")
def _unknown_reason(result: pb.LeaseResult, maker: MessageMaker) -> None:
    result.completed.steps.add(failure=maker.text())


@_result_kind("timings that are no durations")
def _timings(result: pb.LeaseResult, maker: MessageMaker) -> None:
    result.completed.timings.execute_s = maker.number()
    result.completed.timings.load_s = maker.number()


@_result_kind("time in the slot that is no duration")
def _held(result: pb.LeaseResult, maker: MessageMaker) -> None:
    result.held_s, result.slot = maker.number(), maker.count(2**32 - 1)


@_result_kind("final state of 300 kB")
def _long_final(result: pb.LeaseResult, maker: MessageMaker) -> None:
    result.completed.final_state.extend([maker.text()] * 300)


@_result_kind("step with 30 kB of unknown fields")
def _padded_step(result: pb.LeaseResult, maker: MessageMaker) -> None:
    if result.completed.steps:
        result.completed.steps[0].MergeFromString(unknown_field(maker))


@_result_kind("infrastructure failure with any code")
def _any_failure(result: pb.LeaseResult, maker: MessageMaker) -> None:
    result.infra_failure.code = maker.rng.choice((0, 1, 3, 99))  # type: ignore[assignment]
    result.infra_failure.message = maker.text()


@_result_kind("result under another epoch")
def _other_epoch(result: pb.LeaseResult, maker: MessageMaker) -> None:
    result.lease.lease_epoch = maker.count()


@_result_kind("any result of a held lease")
def _any_result(result: pb.LeaseResult, maker: MessageMaker) -> None:
    result.completed.CopyFrom(maker.any(types_pb2.Completed))


@hostile("result of another worker's lease", AttackerRole.WORKER, SESSION)
def _foreign_result(known: Knowledge, maker: MessageMaker) -> Sequence[pb.SessionRequest]:
    result = _random_lie(known, maker)
    if known.foreign:
        result.lease.CopyFrom(maker.rng.choice(known.foreign))
    return [_request(known, results=[result])]


@hostile("replayed result", AttackerRole.WORKER, SESSION)
def _replayed(known: Knowledge, maker: MessageMaker) -> Sequence[pb.SessionRequest]:
    result = _random_lie(known, maker)
    return [_request(known, results=[result, result]), _request(known, results=[result])]


@hostile("result in a wrong session", AttackerRole.WORKER, SESSION)
def _wrong_session(known: Knowledge, maker: MessageMaker) -> Sequence[pb.SessionRequest]:
    request = _request(known, results=[_random_lie(known, maker)])
    request.session_epoch = maker.count()
    return [request]


# Claims


def _claim(known: Knowledge, ref: pb.LeaseRef, origin: pb.LeaseOrigin, copies: int = 1) -> pb.WorkerState:
    state = _own_state(known)
    for _ in range(copies):
        state.claims.add(ref=ref, origin=origin)
        state.running.append(ref)
    return state


@_state_kind("claim of a lease that was never given")
def _claim_made_up(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    ref = pb.LeaseRef(lease_id=f"boot-{maker.rng.randint(1, 99)}", lease_epoch=maker.rng.randint(0, 9))
    return _claim(known, ref, _origin(known, maker))


@_state_kind("claims of equal epochs")
def _claim_ties(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    state = _own_state(known)
    for number in range(4):
        ref = pb.LeaseRef(lease_id=f"tie-{number}", lease_epoch=1)
        state.claims.add(ref=ref, origin=_origin(known, maker))
        state.running.append(ref)
    return state


@_state_kind("claim under another worker's lease")
def _claim_foreign(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    ref = maker.rng.choice(known.foreign) if known.foreign else pb.LeaseRef(lease_id="boot-2", lease_epoch=2)
    return _claim(known, ref, _origin(known, maker), copies=2)


@_state_kind("claim with attempt 4294967295")
def _claim_attempts(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    lease = _lease(known, maker)
    origin = pb.LeaseOrigin()
    origin.CopyFrom(lease.origin)
    origin.attempt = 2**32 - 1
    return _claim(known, pb.LeaseRef(lease_id=lease.ref.lease_id, lease_epoch=0), origin)


@_state_kind("claim that carries its result")
def _claim_result(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    state = _own_state(known)
    result = _random_lie(known, maker)
    result.lease.lease_id, result.lease.lease_epoch = maker.text() or "a", 1
    state.claims.add(ref=result.lease, origin=_origin(known, maker))
    state.finished.append(result)
    return state


# Residents and pauses


@_state_kind("resident with any memory")
def _memory(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    state = _own_state(known)
    for resident in state.residents:
        resident.memory_mb, resident.load_s = maker.number(), maker.number()
    return state


@_state_kind("20,000 residents", SLOW)
def _many(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    del maker
    state = _own_state(known)
    for number in range(MANY_RESIDENTS):
        state.residents.add(
            bundle_digest=f"sha256:{number:064x}", state=pb.RESIDENT_STATE_WARM, memory_mb=1.0
        )
    return state


@_state_kind("resident of a scene that does not exist")
def _unknown_scene(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    state = _own_state(known)
    state.residents.add(bundle_digest=maker.text(), state=pb.RESIDENT_STATE_WARM, memory_mb=1.0)
    return state


@_state_kind("resident that failed with any text")
def _failed_scene(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    state = _own_state(known)
    state.residents[0].state, state.residents[0].error = pb.RESIDENT_STATE_FAILED, maker.text()
    return state


@_state_kind("1,000 failed scenes of new names", SLOW)
def _failed_scenes(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    state = _own_state(known)
    for _ in range(1_000):
        digest = f"sha256:{maker.rng.getrandbits(256):064x}"
        state.residents.add(bundle_digest=digest, state=pb.RESIDENT_STATE_FAILED, error=digest * 20)
    return state


@_state_kind("resident twice in two states")
def _twice(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    del maker
    state = _own_state(known)
    state.residents.add(bundle_digest=state.residents[0].bundle_digest, state=pb.RESIDENT_STATE_LOADING)
    return state


@_state_kind("state that forgets its leases")
def _forgets(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    del maker
    state = _own_state(known)
    del state.running[:]
    return state


@_state_kind("pause with any reason")
def _pause(known: Knowledge, maker: MessageMaker) -> pb.WorkerState:
    state = _own_state(known)
    state.paused = maker.text()
    return state


# Heartbeats, registration, bundles


def _beat(known: Knowledge) -> pb.HeartbeatRequest:
    running = [lease.ref for lease in known.leases]
    return pb.HeartbeatRequest(session_id=known.session_id, session_epoch=known.epoch, running=running)


@hostile("load of NaN", AttackerRole.WORKER, HEARTBEAT)
def _load(known: Knowledge, maker: MessageMaker) -> Sequence[pb.HeartbeatRequest]:
    beat = _beat(known)
    beat.load, beat.memory_used_mb = maker.number(), maker.count()
    return [beat]


@hostile("renewal of another worker's leases", AttackerRole.WORKER, HEARTBEAT)
def _renew_foreign(known: Knowledge, maker: MessageMaker) -> Sequence[pb.HeartbeatRequest]:
    del maker
    beat = _beat(known)
    beat.running.extend(known.foreign)
    return [beat]


@hostile("progress beyond the plan", AttackerRole.WORKER, HEARTBEAT)
def _progress(known: Knowledge, maker: MessageMaker) -> Sequence[pb.HeartbeatRequest]:
    beat = _beat(known)
    for ref in (*beat.running, *known.foreign):
        beat.progress.add(ref=ref, steps=maker.count())
    return [beat]


@hostile("heartbeat in a guessed session", AttackerRole.WORKER, HEARTBEAT)
def _guessed(known: Knowledge, maker: MessageMaker) -> Sequence[pb.HeartbeatRequest]:
    beat = _beat(known)
    beat.session_id = maker.rng.randbytes(8).hex()
    return [beat]


def _register_kind(name: str, weight: float = 1.0) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Decorator: the function damages a sound registration under the worker's own name."""

    def enter(damage: Callable[[pb.RegisterRequest, MessageMaker], None]) -> Callable[..., None]:
        @hostile(name, AttackerRole.WORKER, REGISTER, weight)
        @functools.wraps(damage)
        def make(known: Knowledge, maker: MessageMaker) -> Sequence[pb.RegisterRequest]:
            request = sound_registration(known)
            damage(request, maker)
            return [request]

        return damage

    return enter


def sound_registration(known: Knowledge, join_token: str = "") -> pb.RegisterRequest:
    resources = types_pb2.Resources(slots=2, cores=2, memory_mb=100_000)
    return pb.RegisterRequest(
        worker_id=known.worker_id,
        boot_id=known.worker_id,
        protocol_version=PROTOCOL_VERSION,
        resources=resources,
        join_token=join_token,
    )


@_register_kind("registration with any resources", 0.2)
def _resources(request: pb.RegisterRequest, maker: MessageMaker) -> None:
    request.resources.CopyFrom(maker.any(types_pb2.Resources))


@_register_kind("label of 2 MB", SLOW)
def _labels(request: pb.RegisterRequest, maker: MessageMaker) -> None:
    del maker
    request.resources.labels["room"] = "x" * MANY_LABELS


@_register_kind("4,294,967,295 slots", 0.2)
def _slots(request: pb.RegisterRequest, maker: MessageMaker) -> None:
    del maker
    request.resources.slots = 2**32 - 1


@_register_kind("registration under another name")
def _name(request: pb.RegisterRequest, maker: MessageMaker) -> None:
    request.worker_id = maker.rng.choice(("honest-1", maker.text()))


@_register_kind("registration of another version")
def _version(request: pb.RegisterRequest, maker: MessageMaker) -> None:
    request.protocol_version, request.protocol_low = maker.count(2**32 - 1), maker.count(2**32 - 1)


@hostile("bundle that was not assigned", AttackerRole.WORKER, "WorkerService/FetchBundle")
def _bundle(known: Knowledge, maker: MessageMaker) -> Sequence[pb.FetchBundleRequest]:
    return [pb.FetchBundleRequest(session_id=known.session_id, bundle_digest=maker.text())]
