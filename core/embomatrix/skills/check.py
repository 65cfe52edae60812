"""Preconditions, decided: a call and a view of the world in, a refusal or nothing out.

Both execution modes ask here before they act, so a skill means the same in both. What needs geometry, such as distances,
is a question to the view; the rules are here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.skills.appliance import (
    cold_source,
    cook_temperature_c,
    cooks,
    freezes,
    heat_source,
    heats,
    starts_closed,
)
from embomatrix.skills.check_household import HOUSEHOLD_CHECKS
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.library import LIBRARY, Precondition
from embomatrix.skills.limits import ROBOT
from embomatrix.skills.reach import hidden, out_of_reach, shut_in
from embomatrix.skills.syntax import PlaceRelation, Skill
from embomatrix.skills.view import metres, preposition, refuse, source_of, target_of
from embomatrix.world.state import FREEZE_C, HOT_C

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from embomatrix.skills.appliance import Source
    from embomatrix.skills.syntax import SkillCall
    from embomatrix.skills.view import SkillRefusal, WorldView

    Check = Callable[[WorldView, SkillCall], SkillRefusal | None]


def within_reach(world: WorldView, name: str) -> SkillRefusal | None:
    """Why the arm does not get at an object from where the robot stands, None when it does."""
    return out_of_reach(world, name) or hidden(world, name)


def check(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    """The first precondition of the call that does not hold, as a refusal; None when all do."""
    for precondition in LIBRARY[call.skill].preconditions:
        refusal = CHECKS[precondition](world, call)
        if refusal is not None:
            return refusal
    return None


def _object_listed(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return _listed(world, target_of(world, call), call.object_index)


def _source_listed(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return _listed(world, source_of(world, call), call.source_index)


def _listed(world: WorldView, name: str, index: int | None) -> SkillRefusal | None:
    if not name:
        return refuse(FailureReason.UNKNOWN_INDEX, index=str(index), last=str(len(world.table) - 1))
    return None if world.is_real(name) else refuse(FailureReason.NOT_THERE, target=name)


def _room_known(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    if call.room_name in world.rooms:
        return None
    return refuse(FailureReason.UNKNOWN_ROOM, room=str(call.room_name), rooms=", ".join(world.rooms))


def _step_short(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    distance = call.distance or 0.0
    if abs(distance) <= ROBOT.max_step_m:
        return None
    return refuse(FailureReason.STEP_TOO_LONG, distance=f"{abs(distance):g}", limit=metres(ROBOT.max_step_m))


def _not_carried(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return _hand_full(world) if target_of(world, call) in world.carried else None


def _hand_free(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return _hand_full(world) if world.carried else None


def _hand_full(world: WorldView) -> SkillRefusal:
    return refuse(FailureReason.HAND_FULL, held=world.carried[0])


def _hand_holds(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return None if world.carried else refuse(FailureReason.HAND_EMPTY)


def _not_itself(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    if target_of(world, call) not in world.carried:
        return None
    return refuse(FailureReason.PLACE_ON_ITSELF, held=world.carried[0], relation=_asked(call))


def _portable(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    return refuse(FailureReason.NOT_PORTABLE, target=target) if world.is_fixed(target) else None


def _light_enough(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    mass_kg = sum(world.asset(name).mass_kg for name in world.cargo(target))
    if mass_kg <= ROBOT.mass_kg:
        return None
    return refuse(FailureReason.TOO_HEAVY, target=target, mass=f"{mass_kg:.1f}", limit=f"{ROBOT.mass_kg:.1f}")


def _small_enough(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    size_m = world.asset(target).size_m
    if max(size_m) > ROBOT.extent_m:
        return refuse(
            FailureReason.TOO_LARGE, target=target, size=metres(max(size_m)), limit=metres(ROBOT.extent_m)
        )
    if min(size_m) > ROBOT.grip_m:
        return refuse(
            FailureReason.TOO_LARGE, target=target, size=metres(min(size_m)), limit=metres(ROBOT.grip_m)
        )
    return None


def _bears_nothing(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    other = world.burden(target)
    return refuse(FailureReason.SUPPORTS_OTHERS, target=target, other=other) if other else None


def _in_reach(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return out_of_reach(world, target_of(world, call))


def _source_in_reach(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return out_of_reach(world, source_of(world, call))


def _approachable(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return hidden(world, target_of(world, call))


def _source_approachable(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return hidden(world, source_of(world, call))


def _accessible(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return shut_in(world, target_of(world, call))


def _openable(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    return None if world.asset(target).joints else refuse(FailureReason.NOT_OPENABLE, target=target)


def _is_closed(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    return refuse(FailureReason.ALREADY_OPEN, target=target) if world.is_open(target) else None


def _is_open(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    return None if world.is_open(target) else refuse(FailureReason.ALREADY_CLOSED, target=target)


def _not_running(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    if world.is_on(target) and starts_closed(world.asset(target)):
        return refuse(FailureReason.OPENED_WHILE_ON, target=target)
    return None


def _toggleable(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    return (
        None if world.asset(target).can("toggleable") else refuse(FailureReason.NOT_TOGGLEABLE, target=target)
    )


def _is_off(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    return refuse(FailureReason.ALREADY_ON, target=target) if world.is_on(target) else None


def _is_on(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    return None if world.is_on(target) else refuse(FailureReason.ALREADY_OFF, target=target)


def _closed_to_start(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    if starts_closed(world.asset(target)) and world.is_open(target):
        return refuse(FailureReason.MUST_BE_CLOSED, target=target)
    return None


def _has_cavity(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    if call.relation is not PlaceRelation.INSIDE or world.asset(target).interiors:
        return None
    return refuse(FailureReason.NO_CAVITY, target=target, held=world.carried[0])


def _opened_for(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    if call.relation is not PlaceRelation.INSIDE or world.is_open(target):
        return None
    barred = all(interior.closed_by for interior in world.asset(target).interiors)
    return refuse(FailureReason.CONTAINER_CLOSED, container=target) if barred else None


def _asked(call: SkillCall) -> str:
    return preposition(call.relation) if call.relation is not None else ""


def _source_heats(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    source = source_of(world, call)
    if heat_source(world.asset(source)) is not None:
        return None
    return refuse(FailureReason.NOT_A_HEAT_SOURCE, source=source)


def _source_cools(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    source = source_of(world, call)
    if cold_source(world.asset(source)) is not None:
        return None
    return refuse(FailureReason.NOT_A_COLD_SOURCE, source=source)


def _heatable(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return _able(world, call, "heatable", FailureReason.NOT_HEATABLE)


def _cookable(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return _able(world, call, "cookable", FailureReason.NOT_COOKABLE)


def _freezable(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return _able(world, call, "freezable", FailureReason.NOT_FREEZABLE)


def _able(world: WorldView, call: SkillCall, ability: str, reason: FailureReason) -> SkillRefusal | None:
    target = target_of(world, call)
    return None if world.asset(target).can(ability) else refuse(reason, target=target)


def _at_source(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target, source = target_of(world, call), source_of(world, call)
    if world.is_at(target, source):
        return None
    relation = "inside" if _parameters(world, call).requires_inside else "on top of"
    return refuse(FailureReason.NOT_AT_SOURCE, target=target, source=source, relation=relation)


def _source_on(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    source = source_of(world, call)
    if _parameters(world, call).requires_on and not world.is_on(source):
        return refuse(FailureReason.SOURCE_OFF, source=source)
    return None


def _source_closed(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    source = source_of(world, call)
    if _parameters(world, call).requires_closed and world.is_open(source):
        return refuse(FailureReason.SOURCE_OPEN, source=source)
    return None


def _hot_enough(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    if heats(_parameters(world, call)):
        return None
    return _wrong_temperature(FailureReason.NOT_HOT_ENOUGH, world, call, HOT_C)


def _cooks(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    food = world.asset(target_of(world, call))
    if cooks(_parameters(world, call), food):
        return None
    return _wrong_temperature(FailureReason.NOT_HOT_ENOUGH, world, call, cook_temperature_c(food))


def _cold_enough(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    if freezes(_parameters(world, call)):
        return None
    return _wrong_temperature(FailureReason.NOT_COLD_ENOUGH, world, call, FREEZE_C)


def _parameters(world: WorldView, call: SkillCall) -> Source:
    """The call's source as the skill uses it. SOURCE_HEATS or SOURCE_COOLS has been checked before."""
    asset = world.asset(source_of(world, call))
    found = cold_source(asset) if call.skill is Skill.FREEZE else heat_source(asset)
    assert found is not None
    return found


def _wrong_temperature(
    reason: FailureReason, world: WorldView, call: SkillCall, needed_c: float
) -> SkillRefusal:
    return refuse(
        reason,
        source=source_of(world, call),
        target=target_of(world, call),
        found=f"{_parameters(world, call).temperature_c:.0f}",
        needed=f"{needed_c:.0f}",
    )


CHECKS: Final[Mapping[Precondition, Check]] = {
    Precondition.OBJECT_LISTED: _object_listed,
    Precondition.SOURCE_LISTED: _source_listed,
    Precondition.ROOM_KNOWN: _room_known,
    Precondition.STEP_SHORT: _step_short,
    Precondition.NOT_CARRIED: _not_carried,
    Precondition.HAND_FREE: _hand_free,
    Precondition.HAND_HOLDS: _hand_holds,
    Precondition.NOT_ITSELF: _not_itself,
    Precondition.PORTABLE: _portable,
    Precondition.LIGHT_ENOUGH: _light_enough,
    Precondition.SMALL_ENOUGH: _small_enough,
    Precondition.BEARS_NOTHING: _bears_nothing,
    Precondition.IN_REACH: _in_reach,
    Precondition.APPROACHABLE: _approachable,
    Precondition.ACCESSIBLE: _accessible,
    Precondition.OPENABLE: _openable,
    Precondition.IS_CLOSED: _is_closed,
    Precondition.IS_OPEN: _is_open,
    Precondition.NOT_RUNNING: _not_running,
    Precondition.TOGGLEABLE: _toggleable,
    Precondition.IS_OFF: _is_off,
    Precondition.IS_ON: _is_on,
    Precondition.CLOSED_TO_START: _closed_to_start,
    Precondition.HAS_CAVITY: _has_cavity,
    Precondition.OPENED_FOR: _opened_for,
    Precondition.SOURCE_HEATS: _source_heats,
    Precondition.SOURCE_COOLS: _source_cools,
    Precondition.HEATABLE: _heatable,
    Precondition.COOKABLE: _cookable,
    Precondition.FREEZABLE: _freezable,
    Precondition.SOURCE_IN_REACH: _source_in_reach,
    Precondition.SOURCE_APPROACHABLE: _source_approachable,
    Precondition.AT_SOURCE: _at_source,
    Precondition.SOURCE_ON: _source_on,
    Precondition.SOURCE_CLOSED: _source_closed,
    Precondition.HOT_ENOUGH: _hot_enough,
    Precondition.COOKS: _cooks,
    Precondition.COLD_ENOUGH: _cold_enough,
    **HOUSEHOLD_CHECKS,
}
"""How each precondition is decided."""
