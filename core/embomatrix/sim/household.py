"""Effects of slicing, cleaning and soaking, shared by both execution modes.

Pieces of a sliced object appear in its place: in a row along its longer axis, then further apart and turned, then anywhere on
its host. Each piece must come to rest without penetrating anything.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Final

import numpy as np

from embomatrix.sim.blockers import obstacle_in_words
from embomatrix.sim.state.supports import Host
from embomatrix.skills.appliances import coverings, liquids_given, taken_off
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.syntax import PlaceRelation, SkillCall
from embomatrix.skills.view import SkillRefusal, preposition, refuse, source_of, target_of
from embomatrix.world.geometry import Aabb, Pose
from embomatrix.world.state import THERMAL, State

if TYPE_CHECKING:
    from embomatrix.sim.live_world import LiveWorld

CLEARANCE_M: Final = 0.002
"""Gap between pieces, and above the host, when they are put down."""
SPREADS: Final = (1.0, 1.25, 1.6, 2.0)
"""Spacing of the pieces in multiples of their extent."""
MAX_ROLL_M: Final = 0.15
"""A piece that comes to rest further away has rolled off."""


def cut(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    """Slice the call's target. Changes nothing if its pieces have no room."""
    target = target_of(world, call)
    pieces = world.scene.by_name[target].pieces
    if pieces:
        refusal = _break_up(world, target, pieces, rng)
        if refusal is not None:
            return refusal
    world.states[target].add(State.SLICED)
    return None


def clean(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    """Remove the substances that the tool in the hand removes. Sinks and machines act by themselves."""
    target, tool = target_of(world, call), source_of(world, call)
    if tool in world.carried:
        covering = coverings(world.substances[target])
        found = taken_off(world.asset(tool), world.substances[tool], covering, on=world.is_on(tool))
        world.water.take_off(target, found)
    return None


def soak(world: LiveWorld, call: SkillCall, rng: np.random.Generator) -> SkillRefusal | None:
    """Wet the target with the source's liquids."""
    target, source = target_of(world, call), source_of(world, call)
    given = liquids_given(world.asset(source), world.substances[source], on=world.is_on(source))
    world.water.wet(target, given)
    return None


def _break_up(
    world: LiveWorld, whole: str, pieces: tuple[str, ...], rng: np.random.Generator
) -> SkillRefusal | None:
    host = world.relations.host_of(whole)
    box, base = world.engine.aabb(whole), world.engine.pose(whole)
    world.engine.park(whole)
    if not (_side_by_side(world, pieces, box, base) or _on_host(world, pieces, host, rng)):
        world.engine.set_pose(whole, base)
        other = ""
        if host is not None:
            _, other = world.placer.hindrance(pieces[0], host.name, host.relation, (world.robot,))
        return refuse(
            FailureReason.NO_FREE_POSE,
            held=f"the pieces of {whole}",
            relation=preposition(PlaceRelation(host.relation.value)) if host is not None else "on top of",
            target=host.name if host is not None else "the floor",
            other=obstacle_in_words(other),
        )
    world.absent.add(whole)
    world.absent.difference_update(pieces)
    for piece in pieces:
        world.states[piece] |= world.states[whole] & THERMAL
        world.treatments[piece] |= world.treatments[whole]
        world.substances[piece] |= world.substances[whole]
    world.navigator.refresh()
    return None


def _side_by_side(world: LiveWorld, pieces: tuple[str, ...], box: Aabb, base: Pose) -> bool:
    """Return True if all pieces fit in a row through the middle of the whole's box; park them otherwise."""
    return any(
        all(
            _rests(world, piece, pose)
            for piece, pose in zip(pieces, _row(world, pieces, box, yaw, spread), strict=True)
        )
        or _parked(world, pieces)
        for spread in SPREADS
        for yaw in _courses(box, base)
    )


def _courses(box: Aabb, base: Pose) -> tuple[float, ...]:
    """Directions of a row of pieces: along the longer side of the whole, then across, then diagonal."""
    along = base.yaw if box.size_m[0] >= box.size_m[1] else base.yaw + math.pi / 2
    return (along, along + math.pi / 2, along + math.pi / 4, along - math.pi / 4)


def _row(world: LiveWorld, pieces: tuple[str, ...], box: Aabb, yaw: float, spread: float) -> Iterator[Pose]:
    """Poses of the pieces in a row along ``yaw``, their undersides level with the whole's."""
    x, y, _ = box.center_m
    widths = [world.asset(piece).size_m[0] * spread + CLEARANCE_M for piece in pieces]
    start = -sum(widths) / 2
    for piece, width in zip(pieces, widths, strict=True):
        shift = start + width / 2
        start += width
        height = box.low_m[2] + world.asset(piece).size_m[2] / 2 + CLEARANCE_M
        yield Pose.from_xyz_yaw(x + shift * math.cos(yaw), y + shift * math.sin(yaw), height, yaw)


def _rests(world: LiveWorld, piece: str, pose: Pose) -> bool:
    """Let the piece settle at the pose. Return True if it stays near and penetrates nothing."""
    engine = world.engine
    engine.set_pose(piece, pose)
    if engine.penetrates(piece):
        return False
    settled = engine.settle(piece)
    engine.set_pose(piece, settled.pose)
    return settled.at_rest and settled.moved_m <= MAX_ROLL_M and not engine.penetrates(piece)


def _parked(world: LiveWorld, pieces: tuple[str, ...]) -> bool:
    """Take the pieces out of the world. Always returns False."""
    for piece in pieces:
        world.engine.park(piece)
    return False


def _on_host(world: LiveWorld, pieces: tuple[str, ...], host: Host | None, rng: np.random.Generator) -> bool:
    """Return True if all pieces find a place on or in the whole's host; park them otherwise."""
    if host is None:
        return False
    for piece in pieces:
        found = world.placer.find(piece, host.name, host.relation, world.robot, rng)
        if not isinstance(found, Pose):
            return _parked(world, pieces)
        world.engine.set_pose(piece, found)
    return True
