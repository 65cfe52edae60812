"""Execution of plans in a scene: preconditions, actions, effects of heat and water, and the trace."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Iterator, Sequence, Set
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from embomatrix.sim.actions import CachedActor
from embomatrix.sim.engine import PhysicsEngine
from embomatrix.sim.live_world import LiveWorld, WorldMark
from embomatrix.sim.sight import rows_in_sight
from embomatrix.sim.state.sources import Change
from embomatrix.skills.check import check
from embomatrix.skills.describe import ObjectDescription, done, final_lines, gained, lines_of
from embomatrix.skills.syntax import Plan, Skill, SkillCall
from embomatrix.skills.trace import Step, Trace
from embomatrix.skills.turns import TurnObservation
from embomatrix.skills.view import SkillRefusal, source_of, target_of
from embomatrix.world.bundle import Bundle
from embomatrix.world.state import State
from embomatrix.world.substances import in_words
from embomatrix.world.task import Task

CHANGING = frozenset(
    {
        Skill.PLACE,
        Skill.OPEN,
        Skill.CLOSE,
        Skill.TOGGLE_ON,
        Skill.TOGGLE_OFF,
        Skill.SLICE,
        Skill.CLEAN,
        Skill.SOAK,
    }
)
"""Skills after which a source may act on new objects, or which add and remove substances."""


class Actor(Protocol):
    """Execution mode: carries out calls whose preconditions hold."""

    @property
    def drawing(self) -> Set[Skill]:
        """Skills that draw random numbers. The actor must not use ``rng`` for the others."""

    @property
    def keeps_state(self) -> bool:
        """True if the actor has state of its own, besides the world's."""

    def reset(self, world: LiveWorld) -> None:
        """Start a rollout: ``world`` is at the scene's start."""

    def act(self, world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
        """Carry out a call and leave its outcome in ``world``.

        Returns None for a success, else the refusal. ``rng`` decides between equally good outcomes.
        """

    def close(self) -> None:
        """Free the actor's resources and end its use."""


@dataclass(frozen=True, slots=True)
class Mark:
    """State of an execution after some calls. It belongs to the simulator that made it."""

    task: Task
    calls: Plan
    """Calls so far, in a mode that returns by executing them again."""
    succeeded: int
    touched: frozenset[str]
    hash: hashlib._Hash
    world: WorldMark | None
    """None in such a mode."""

    def digest(self, seed: int) -> str:
        """Digest of an episode that is in this state: its task, its seed, and every pose and state after every call."""
        episode = f"{self.task.task_id}\n{seed}\n".encode() + self.hash.digest()
        return f"sha256:{hashlib.sha256(episode).hexdigest()}"


@dataclass(frozen=True, slots=True)
class TurnRun:
    """Execution of a turn: the calls of a prefix, which may fail, and further calls up to the first failure."""

    steps: tuple[Step, ...]
    """Those of the prefix, then the others."""
    prefix_digest: str
    """Digest of the episode after the prefix."""
    digest: str
    """Digest of the episode after all steps."""
    touched: frozenset[str]
    """Objects on which a call succeeded."""
    observation: TurnObservation


class StepRandom:
    """Random generator of the steps; its output at a step depends on the seed and the step only.

    One generator is reseeded, because making a new one costs more than a skill does.
    """

    def __init__(self) -> None:
        self._bits = np.random.PCG64(0)
        self.generator = np.random.Generator(self._bits)

    def go_to(self, seed: int, step: int) -> None:
        """Move the generator to the start of a step's stream.

        State and increment of PCG64 (O'Neill 2014) are the two halves of a hash; any state and any odd increment give a full
        period.
        """
        digest = hashlib.sha256(f"{seed}:{step}".encode()).digest()
        state, increment = (int.from_bytes(half, "little") for half in (digest[:16], digest[16:]))
        self._bits.state = {
            "bit_generator": "PCG64",
            "state": {"state": state, "inc": increment | 1},
            "has_uint32": 0,
            "uinteger": 0,
        }


class Simulator:
    """Scene of a bundle, loaded once for many executions. Not thread-safe.

    ``execute`` runs a whole plan; ``reset`` and ``run_step`` run one call at a time.
    """

    def __init__(self, bundle: Bundle, engine: PhysicsEngine, actor: Actor | None = None) -> None:
        """``engine`` holds the bundle's scene; ``actor`` is the execution mode, cached by default.

        The simulator closes both.
        """
        self.world = LiveWorld(bundle, engine)
        """Current state, live until the next reset. Read-only."""
        self.facts = self.world.facts
        """Facts of the current state, live until the next reset."""
        self._tables = [task.table for task in bundle.tasks.values()]
        self._actor: Actor = actor if actor is not None else CachedActor()
        self._draws = StepRandom()
        self._task: Task | None = None
        self._seed = 0
        self._succeeded = 0
        self._calls: list[SkillCall] = []
        self._hash = hashlib.sha256()
        self._touched: set[str] = set()
        self._as_loaded: dict[str, ObjectDescription] = {}
        """Descriptions of objects in the scene as loaded."""

    @property
    def touched(self) -> frozenset[str]:
        """Objects on which a call succeeded since the last reset."""
        return frozenset(self._touched)

    @property
    def drawing(self) -> Set[Skill]:
        """Skills whose calls draw random numbers. Until the first of them, the seed changes nothing."""
        return self._actor.drawing

    def draw_from(self, seed: int) -> None:
        """Continue with another seed. No call since the last reset may have drawn."""
        self._seed = seed

    def reset(self, task: Task, seed: int) -> None:
        """Return to the scene's start. ``seed`` (not negative) decides between equally good outcomes."""
        self.world.reset(task)
        self._actor.reset(self.world)
        self._task = task
        self._seed = seed
        self._succeeded = 0
        self._calls.clear()
        self._touched = set()
        self._hash = hashlib.sha256(self.world.scene.scene_id.encode())
        self._hash.update(self.world.state_bytes())

    def run_step(self, call: SkillCall) -> Step:
        """Execute one call in the current state; the caller decides whether to continue after a failure.

        A call that its preconditions refuse changes nothing, nor does a failed call in cached mode.
        """
        world = self.world
        if self._actor.keeps_state:
            self._calls.append(call)
        held = world.carried[:1]
        refusal = check(world, call)
        if refusal is None:
            if call.skill in self._actor.drawing:
                # Equal plan prefixes see equal numbers: the stream depends on the seed and on how many calls succeeded.
                self._draws.go_to(self._seed, self._succeeded + 1)
            refusal = self._actor.act(world, call, self._draws.generator)
        if refusal is not None:
            self._hash.update(world.state_bytes() + refusal.reason.encode())
            return Step(call, refusal.reason, refusal.sentence, refusal.blocker)
        self._succeeded += 1
        changes = world.let_sources_act() if call.skill in CHANGING else ()
        self._touched.update(filter(None, (target_of(world, call), source_of(world, call))))
        self._hash.update(world.state_bytes())
        return Step(call, None, self._message(call, held, changes))

    def mark(self) -> Mark:
        """Return the present state for ``return_to``. Raises RuntimeError before the first reset."""
        if self._task is None:
            raise RuntimeError("nothing was executed: reset the simulator before it is marked")
        world = None if self._actor.keeps_state else self.world.mark()
        return Mark(
            self._task,
            tuple(self._calls) if world is None else (),
            self._succeeded,
            self.touched,
            self._hash.copy(),
            world,
        )

    def mark_after_failure(self, before: Mark) -> Mark:
        """Return the present state after one call that failed, given the mark before it.

        Where failed calls change nothing, the two share the state of the world.
        """
        return self.mark() if before.world is None else replace(before, hash=self._hash.copy())

    def return_to(self, mark: Mark, seed: int) -> None:
        """Take on a state that this simulator marked. What follows is bit-equal to what follows the same calls with ``seed``.

        No call before the mark may have drawn a random number, unless with this seed. The time depends on the number of
        objects that have changed. A mode whose actor keeps state of its own executes the calls again.
        """
        if mark.world is None:
            self.reset(mark.task, seed)
            for call in mark.calls:
                self.run_step(call)
            return
        self.world.return_to(mark.world)
        self._task, self._seed = mark.task, seed
        self._succeeded = mark.succeeded
        self._touched = set(mark.touched)
        self._hash = mark.hash.copy()

    def execute(
        self, task: Task, plan: Plan, seed: int, on_step: Callable[[int], None] = lambda _: None
    ) -> Trace:
        """Reset and run the plan to its end or first failed step. ``on_step`` receives the number of finished steps."""
        self.reset(task, seed)
        steps: list[Step] = []
        self._run_to_failure(plan, steps, on_step)
        return self.trace(task, plan, steps)

    def _run_to_failure(self, calls: Plan, steps: list[Step], on_step: Callable[[int], None]) -> None:
        """Run the calls to their end or first failed one, and append their steps."""
        for call in calls:
            steps.append(self.run_step(call))
            on_step(len(steps))
            if not steps[-1].ok:
                break

    def trace(self, task: Task, plan: Plan, steps: Sequence[Step]) -> Trace:
        """Return the trace of a plan whose steps led to the present state."""
        return Trace(
            plan=plan,
            steps=tuple(steps),
            touched=self.touched,
            final=self.describe(task),
            digest=f"sha256:{self._hash.hexdigest()}",
        )

    def execute_turn(
        self,
        task: Task,
        plan: Plan,
        seed: int,
        prefix: int,
        on_step: Callable[[int], None] = lambda _: None,
        *,
        sight: bool = False,
    ) -> TurnRun:
        """Reset and run the plan. Failures end it only after the first ``prefix`` calls."""
        self.reset(task, seed)
        steps: list[Step] = []
        for call in plan[:prefix]:
            steps.append(self.run_step(call))
            on_step(len(steps))
        start, before = self.mark(), self.world.mark()
        self._run_to_failure(plan[prefix:], steps, on_step)
        end = self.mark()
        digests = start.digest(seed), end.digest(seed)
        return TurnRun(tuple(steps), *digests, end.touched, self.observe(task, before, sight=sight))

    def describe(self, task: Task) -> tuple[str, ...]:
        """State in words of the goal's objects and of those that a call succeeded on, in the table's order."""
        described = task.goal_objects | self._touched
        names = [name for name in task.table if name in described]
        return final_lines([self._description(name) for name in names])

    def survey(self, task: Task) -> tuple[str, ...]:
        """State in words of every object in the task's table, in its order; it reveals nothing about the goal."""
        return lines_of(self._description(name) for name in task.table)

    def observe(self, task: Task, before: WorldMark, *, sight: bool = False) -> TurnObservation:
        """Describe the present state and what has changed since another state of this task.

        With ``sight``, say which rows of the table the robot sees.
        """
        changed = self.world.mark().changed_since(before)
        changes = lines_of(self._description(name) for name in task.table if name in changed)
        sees = rows_in_sight(self.world) if sight else ()
        return TurnObservation(self.world.robot_room, self.world.carried, changes, sight, sees)

    def warm_up(self) -> Iterator[None]:
        """Compute cached values ahead of their first use, a little per step. Changes no answer.

        An idle process runs this before it forks slots, which then share the values.
        """
        world = self.world
        yield from world.relations.supports.warm_up()
        for name in dict.fromkeys(itertools.chain.from_iterable(self._tables)):
            self._description(name)
            yield
        yield from world.placer.warm_up()
        yield from world.navigator.warm_up()
        yield from world.swings.warm_up()
        yield from world.warm_up(self._tables)
        # Least useful, so last: a slot that is forked early misses it the least.
        yield from world.placer.warm_up_pairs(self._tables)

    def close(self) -> None:
        """Close the engine and the actor and end the simulator's use."""
        self._actor.close()
        self.world.engine.close()

    def _message(self, call: SkillCall, held: Sequence[str], changes: Sequence[Change]) -> str:
        cargo = self.world.carried[1:] if call.skill is Skill.PICK_UP else ()
        sentence = done(call, target=target_of(self.world, call), held=held[0] if held else "", cargo=cargo)
        if not changes:
            return sentence
        by_object: dict[str, list[str]] = {}
        for change in changes:
            by_object.setdefault(change.name, []).append(change.words)
        return f"{sentence}; {gained(by_object)}"

    def _description(self, name: str) -> ObjectDescription:
        """Describe an object. Most are as loaded."""
        if not self.world.is_untouched(name):
            return self._describe(name)
        known = self._as_loaded.get(name)
        if known is None:
            known = self._as_loaded[name] = self._describe(name)
        return known

    def _describe(self, name: str) -> ObjectDescription:
        world = self.world
        host = world.hand.hosts.get(name) or world.relations.host_of(name)
        asset = world.asset(name)
        states: list[str] = []
        if asset.joints:
            states.append("open" if world.is_open(name) else "closed")
        if asset.can("toggleable"):
            states.append("on" if world.is_on(name) else "off")
        if symbols := world.states.get(name):
            states += sorted(state.value for state in symbols if state is not State.TOGGLED_ON)
        if facts := world.substances.get(name):
            states += [in_words(fact) for fact in sorted(facts)]
        return ObjectDescription(
            name=name,
            room=world.room_of(name),
            host=host.name if host is not None else "",
            relation=host.relation if host is not None else None,
            held=name in world.carried,
            gone=not world.is_real(name),
            states=tuple(states),
        )
