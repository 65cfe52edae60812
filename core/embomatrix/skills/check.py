"""Precondition checks: decide from a call and a view of the world whether the call may start.

Both execution modes run these checks before they act, so a skill means the same in both. Questions of geometry, such as
distances, go to the view.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, NamedTuple

from embomatrix.skills.appliances import (
    ThermalSource,
    cold_source,
    cook_temperature_c,
    cooks,
    coverings,
    freezes,
    gives_liquid,
    heat_source,
    heats,
    is_cleaner,
    liquids_given,
    missing_for,
    soaks_up,
    starts_closed,
    washed_away,
    washing,
)
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.library import LIBRARY, Precondition
from embomatrix.skills.limits import ROBOT
from embomatrix.skills.syntax import PlaceRelation, Skill, SkillCall
from embomatrix.skills.view import SkillRefusal, WorldView, metres, preposition, refuse, source_of, target_of
from embomatrix.world.asset import Asset
from embomatrix.world.state import FREEZE_C, HOT_C
from embomatrix.world.substances import RUNNING, word_of

Check = Callable[["BoundCall"], SkillRefusal | None]


class BoundCall(NamedTuple):
    """A call whose indices are resolved to object names in one world; "" for an absent or unknown index."""

    world: WorldView
    call: SkillCall
    target: str
    source: str

    @property
    def target_asset(self) -> Asset:
        return self.world.asset(self.target)

    @property
    def source_asset(self) -> Asset:
        return self.world.asset(self.source)

    @property
    def goes_inside(self) -> bool:
        return self.call.relation is PlaceRelation.INSIDE

    @property
    def thermal_source(self) -> ThermalSource:
        """The source as the skill uses it. Call it only after SOURCE_HEATS or SOURCE_COOLS has been checked."""
        asset = self.source_asset
        found = cold_source(asset) if self.call.skill is Skill.FREEZE else heat_source(asset)
        assert found is not None
        return found

    def refuse(self, reason: FailureReason, **values: str) -> SkillRefusal:
        """Return the refusal for this call. Target, source, held object and relation fill in the sentence by default."""
        carried, relation = self.world.carried, self.call.relation
        values.setdefault("relation", preposition(relation) if relation is not None else "")
        held = carried[0] if carried else ""
        return refuse(reason, target=self.target, source=self.source, held=held, **values)


@dataclass(frozen=True, slots=True)
class Rule:
    """Check of one precondition, with every reason that it can give for a refusal."""

    reasons: tuple[FailureReason, ...]
    check: Check


def check(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    """Return a refusal for the first precondition of the call that does not hold, None when all hold."""
    bound = BoundCall(world, call, target_of(world, call), source_of(world, call))
    for holds in _CHECKS[call.skill]:
        refusal = holds(bound)
        if refusal is not None:
            return refusal
    return None


def within_reach(world: WorldView, name: str) -> SkillRefusal | None:
    """Return None if the arm reaches an object from the robot's present pose, else the refusal."""
    return _out_of_reach(world, name) or _hidden(world, name)


def _out_of_reach(world: WorldView, name: str) -> SkillRefusal | None:
    reach = world.reach(name)
    if reach.height_m > ROBOT.reach_high_m:
        height, limit = metres(reach.height_m), metres(ROBOT.reach_high_m)
        return refuse(FailureReason.TOO_HIGH, target=name, height=height, limit=limit)
    if reach.distance_m > ROBOT.reach_m:
        distance, limit = metres(reach.distance_m), metres(ROBOT.reach_m)
        return refuse(FailureReason.OUT_OF_REACH, target=name, distance=distance, limit=limit)
    return None


def _hidden(world: WorldView, name: str) -> SkillRefusal | None:
    return None if world.is_approachable(name) else refuse(FailureReason.NO_LINE_OF_APPROACH, target=name)


def _shut_in(world: WorldView, name: str) -> SkillRefusal | None:
    container = world.closed_around(name)
    return refuse(FailureReason.CONTAINER_CLOSED, container=container) if container else None


def _listed(world: WorldView, name: str, index: int | None) -> SkillRefusal | None:
    if not name:
        return refuse(FailureReason.UNKNOWN_INDEX, index=str(index), last=str(len(world.table) - 1))
    return None if world.is_real(name) else refuse(FailureReason.NOT_THERE, target=name)


def _room_known(bound: BoundCall) -> SkillRefusal | None:
    room, rooms = bound.call.room_name, bound.world.rooms
    if room in rooms:
        return None
    return refuse(FailureReason.UNKNOWN_ROOM, room=str(room), rooms=", ".join(rooms))


def _step_short(bound: BoundCall) -> SkillRefusal | None:
    distance = abs(bound.call.distance or 0.0)
    if distance <= ROBOT.max_step_m:
        return None
    return refuse(FailureReason.STEP_TOO_LONG, distance=f"{distance:g}", limit=metres(ROBOT.max_step_m))


def _light_enough(bound: BoundCall) -> SkillRefusal | None:
    mass_kg = sum(bound.world.asset(name).mass_kg for name in bound.world.cargo(bound.target))
    if mass_kg <= ROBOT.mass_kg:
        return None
    return bound.refuse(FailureReason.TOO_HEAVY, mass=f"{mass_kg:.1f}", limit=f"{ROBOT.mass_kg:.1f}")


def _small_enough(bound: BoundCall) -> SkillRefusal | None:
    size_m = bound.target_asset.size_m
    for extent_m, limit_m in ((max(size_m), ROBOT.extent_m), (min(size_m), ROBOT.grip_m)):
        if extent_m > limit_m:
            return bound.refuse(FailureReason.TOO_LARGE, size=metres(extent_m), limit=metres(limit_m))
    return None


def _bears_nothing(bound: BoundCall) -> SkillRefusal | None:
    other = bound.world.burden(bound.target)
    return bound.refuse(FailureReason.SUPPORTS_OTHERS, other=other) if other else None


def _opened_for(bound: BoundCall) -> SkillRefusal | None:
    if not bound.goes_inside or bound.world.is_open(bound.target):
        return None
    closed = all(interior.closed_by for interior in bound.target_asset.interiors)
    return bound.refuse(FailureReason.CONTAINER_CLOSED, container=bound.target) if closed else None


def _at_source(bound: BoundCall) -> SkillRefusal | None:
    if bound.world.is_at(bound.target, bound.source):
        return None
    relation = "inside" if bound.thermal_source.requires_inside else "on top of"
    return bound.refuse(FailureReason.NOT_AT_SOURCE, relation=relation)


def _wrong_temperature(reason: FailureReason, bound: BoundCall, needed_c: float) -> SkillRefusal:
    found_c = bound.thermal_source.temperature_c
    return bound.refuse(reason, found=f"{found_c:.0f}", needed=f"{needed_c:.0f}")


def _hot_enough(bound: BoundCall) -> SkillRefusal | None:
    if heats(bound.thermal_source):
        return None
    return _wrong_temperature(FailureReason.NOT_HOT_ENOUGH, bound, HOT_C)


def _cooks(bound: BoundCall) -> SkillRefusal | None:
    food = bound.target_asset
    if cooks(bound.thermal_source, food):
        return None
    return _wrong_temperature(FailureReason.NOT_HOT_ENOUGH, bound, cook_temperature_c(food))


def _cold_enough(bound: BoundCall) -> SkillRefusal | None:
    if freezes(bound.thermal_source):
        return None
    return _wrong_temperature(FailureReason.NOT_COLD_ENOUGH, bound, FREEZE_C)


def _worked_on(bound: BoundCall) -> SkillRefusal | None:
    if washing(bound.source_asset) is not None:
        return None
    return within_reach(bound.world, bound.target) or _shut_in(bound.world, bound.target)


def _washed(bound: BoundCall) -> SkillRefusal | None:
    world, machine = bound.world, washing(bound.source_asset)
    if machine is None:
        return None
    if not world.is_inside(bound.target, bound.source):
        return bound.refuse(FailureReason.NOT_AT_SOURCE, relation="inside")
    if not world.is_on(bound.source):
        return bound.refuse(FailureReason.SOURCE_OFF)
    if machine.requires_closed and world.is_open(bound.source):
        return bound.refuse(FailureReason.SOURCE_OPEN)
    return None


def _comes_off(bound: BoundCall) -> SkillRefusal | None:
    """Accept a clean object too: running water may clean it before this call does."""
    asset, covering = bound.source_asset, coverings(bound.world.facts_about(bound.target))
    machine = washing(asset)
    lacking: Mapping[str, tuple[str, ...] | None]
    if machine is not None:
        lacking = dict.fromkeys(covering) if not washed_away(machine, covering) else {}
    else:
        facts, on = bound.world.facts_about(bound.source), bound.world.is_on(bound.source)
        lacking = {name: missing_for(asset, facts, name, on=on) for name in covering}
    if not lacking or () in lacking.values():
        return None
    # A remedy for the tool is reported before a substance that the tool never removes.
    remedied = ((name, needed) for name, needed in lacking.items() if needed)
    substance, needed = next(remedied, (covering[0], None))
    if needed is None:
        return bound.refuse(FailureReason.STAYS_ON, substance=word_of(substance))
    if RUNNING in needed:
        return bound.refuse(FailureReason.SOURCE_OFF)
    liquids = " or ".join(map(word_of, needed))
    return bound.refuse(FailureReason.NEEDS_SOAKING, substance=word_of(substance), needed=liquids)


def _under_source(bound: BoundCall) -> SkillRefusal | None:
    held = bound.target in bound.world.carried[:1] and bound.target != bound.source
    if held or bound.world.is_inside(bound.target, bound.source):
        return None
    return bound.refuse(FailureReason.NOT_AT_SOURCE, relation="in the hand or inside")


def _require(reason: FailureReason, holds: Callable[[BoundCall], bool]) -> Rule:
    """Return the rule that refuses a call for one reason unless a condition holds."""
    return Rule((reason,), lambda bound: None if holds(bound) else bound.refuse(reason))


_LISTED: Final = (FailureReason.UNKNOWN_INDEX, FailureReason.NOT_THERE)
_REACH: Final = (FailureReason.OUT_OF_REACH, FailureReason.TOO_HIGH)

RULES: Final[Mapping[Precondition, Rule]] = {
    Precondition.OBJECT_LISTED: Rule(_LISTED, lambda b: _listed(b.world, b.target, b.call.object_index)),
    Precondition.SOURCE_LISTED: Rule(_LISTED, lambda b: _listed(b.world, b.source, b.call.source_index)),
    Precondition.ROOM_KNOWN: Rule((FailureReason.UNKNOWN_ROOM,), _room_known),
    Precondition.STEP_SHORT: Rule((FailureReason.STEP_TOO_LONG,), _step_short),
    Precondition.NOT_CARRIED: _require(FailureReason.HAND_FULL, lambda b: b.target not in b.world.carried),
    Precondition.HAND_FREE: _require(FailureReason.HAND_FULL, lambda b: not b.world.carried),
    Precondition.HAND_HOLDS: _require(FailureReason.HAND_EMPTY, lambda b: bool(b.world.carried)),
    Precondition.NOT_ITSELF: _require(
        FailureReason.PLACE_ON_ITSELF, lambda b: b.target not in b.world.carried
    ),
    Precondition.PORTABLE: _require(FailureReason.NOT_PORTABLE, lambda b: not b.world.is_fixed(b.target)),
    Precondition.LIGHT_ENOUGH: Rule((FailureReason.TOO_HEAVY,), _light_enough),
    Precondition.SMALL_ENOUGH: Rule((FailureReason.TOO_LARGE,), _small_enough),
    Precondition.BEARS_NOTHING: Rule((FailureReason.SUPPORTS_OTHERS,), _bears_nothing),
    Precondition.IN_REACH: Rule(_REACH, lambda b: _out_of_reach(b.world, b.target)),
    Precondition.APPROACHABLE: _require(
        FailureReason.NO_LINE_OF_APPROACH, lambda b: b.world.is_approachable(b.target)
    ),
    Precondition.ACCESSIBLE: Rule((FailureReason.CONTAINER_CLOSED,), lambda b: _shut_in(b.world, b.target)),
    Precondition.OPENABLE: _require(FailureReason.NOT_OPENABLE, lambda b: bool(b.target_asset.joints)),
    Precondition.IS_CLOSED: _require(FailureReason.ALREADY_OPEN, lambda b: not b.world.is_open(b.target)),
    Precondition.IS_OPEN: _require(FailureReason.ALREADY_CLOSED, lambda b: b.world.is_open(b.target)),
    Precondition.NOT_RUNNING: _require(
        FailureReason.OPENED_WHILE_ON,
        lambda b: not (b.world.is_on(b.target) and starts_closed(b.target_asset)),
    ),
    Precondition.TOGGLEABLE: _require(
        FailureReason.NOT_TOGGLEABLE, lambda b: b.target_asset.can("toggleable")
    ),
    Precondition.IS_OFF: _require(FailureReason.ALREADY_ON, lambda b: not b.world.is_on(b.target)),
    Precondition.IS_ON: _require(FailureReason.ALREADY_OFF, lambda b: b.world.is_on(b.target)),
    Precondition.CLOSED_TO_START: _require(
        FailureReason.MUST_BE_CLOSED,
        lambda b: not (starts_closed(b.target_asset) and b.world.is_open(b.target)),
    ),
    Precondition.HAS_CAVITY: _require(
        FailureReason.NO_CAVITY, lambda b: not b.goes_inside or bool(b.target_asset.interiors)
    ),
    Precondition.OPENED_FOR: Rule((FailureReason.CONTAINER_CLOSED,), _opened_for),
    Precondition.SOURCE_HEATS: _require(
        FailureReason.NOT_A_HEAT_SOURCE, lambda b: heat_source(b.source_asset) is not None
    ),
    Precondition.SOURCE_COOLS: _require(
        FailureReason.NOT_A_COLD_SOURCE, lambda b: cold_source(b.source_asset) is not None
    ),
    Precondition.HEATABLE: _require(FailureReason.NOT_HEATABLE, lambda b: b.target_asset.can("heatable")),
    Precondition.COOKABLE: _require(FailureReason.NOT_COOKABLE, lambda b: b.target_asset.can("cookable")),
    Precondition.FREEZABLE: _require(FailureReason.NOT_FREEZABLE, lambda b: b.target_asset.can("freezable")),
    Precondition.SOURCE_IN_REACH: Rule(_REACH, lambda b: _out_of_reach(b.world, b.source)),
    Precondition.SOURCE_APPROACHABLE: Rule(
        (FailureReason.NO_LINE_OF_APPROACH,), lambda b: _hidden(b.world, b.source)
    ),
    Precondition.AT_SOURCE: Rule((FailureReason.NOT_AT_SOURCE,), _at_source),
    Precondition.SOURCE_ON: _require(
        FailureReason.SOURCE_OFF, lambda b: not b.thermal_source.requires_on or b.world.is_on(b.source)
    ),
    Precondition.SOURCE_CLOSED: _require(
        FailureReason.SOURCE_OPEN,
        lambda b: not (b.thermal_source.requires_closed and b.world.is_open(b.source)),
    ),
    Precondition.HOT_ENOUGH: Rule((FailureReason.NOT_HOT_ENOUGH,), _hot_enough),
    Precondition.COOKS: Rule((FailureReason.NOT_HOT_ENOUGH,), _cooks),
    Precondition.COLD_ENOUGH: Rule((FailureReason.NOT_COLD_ENOUGH,), _cold_enough),
    Precondition.SOURCE_CUTS: _require(FailureReason.NOT_A_SLICER, lambda b: b.source_asset.can("slicer")),
    Precondition.SLICEABLE: _require(FailureReason.NOT_SLICEABLE, lambda b: b.target_asset.can("sliceable")),
    Precondition.NOT_SLICED: _require(
        FailureReason.ALREADY_SLICED, lambda b: not b.world.is_sliced(b.target)
    ),
    Precondition.SOURCE_HELD: _require(
        FailureReason.TOOL_NOT_HELD,
        lambda b: b.source in b.world.carried[:1] or washing(b.source_asset) is not None,
    ),
    Precondition.SOURCE_CLEANS: _require(
        FailureReason.NOT_A_CLEANER, lambda b: is_cleaner(b.source_asset, b.world.facts_about(b.source))
    ),
    Precondition.WORKED_ON: Rule(
        (*_REACH, FailureReason.NO_LINE_OF_APPROACH, FailureReason.CONTAINER_CLOSED), _worked_on
    ),
    Precondition.WASHED: Rule(
        (FailureReason.NOT_AT_SOURCE, FailureReason.SOURCE_OFF, FailureReason.SOURCE_OPEN), _washed
    ),
    Precondition.COMES_OFF: Rule(
        (FailureReason.NEEDS_SOAKING, FailureReason.SOURCE_OFF, FailureReason.STAYS_ON), _comes_off
    ),
    Precondition.SOURCE_WETS: _require(
        FailureReason.GIVES_NO_LIQUID, lambda b: gives_liquid(b.source_asset, b.world.facts_about(b.source))
    ),
    Precondition.SOAKABLE: _require(FailureReason.NOT_SOAKABLE, lambda b: soaks_up(b.target_asset)),
    Precondition.SOURCE_ACCESSIBLE: Rule(
        (FailureReason.CONTAINER_CLOSED,), lambda b: _shut_in(b.world, b.source)
    ),
    Precondition.UNDER_SOURCE: Rule((FailureReason.NOT_AT_SOURCE,), _under_source),
    Precondition.SOURCE_FLOWS: _require(
        FailureReason.SOURCE_OFF,
        lambda b: bool(
            liquids_given(b.source_asset, b.world.facts_about(b.source), on=b.world.is_on(b.source))
        ),
    ),
}
"""Rule of each precondition."""

_CHECKS: Final = {
    skill: tuple(RULES[precondition].check for precondition in found.preconditions)
    for skill, found in LIBRARY.items()
}
"""Checks of each skill's preconditions, in their order."""
