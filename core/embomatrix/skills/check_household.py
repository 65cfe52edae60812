"""Preconditions of the skills that cut, clean and wet: a part of `embomatrix.skills.check`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from embomatrix.skills.failure import FailureReason
from embomatrix.skills.household import (
    coverings,
    cuts,
    gives_liquid,
    is_cleaner,
    is_sliceable,
    liquids_given,
    missing_for,
    soaks_up,
    washed_away,
    washing,
)
from embomatrix.skills.library import Precondition
from embomatrix.skills.reach import hidden, out_of_reach, shut_in
from embomatrix.skills.view import refuse, source_of, target_of
from embomatrix.world.substances import RUNNING, word_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from embomatrix.skills.syntax import SkillCall
    from embomatrix.skills.view import SkillRefusal, WorldView

    Check = Callable[[WorldView, SkillCall], SkillRefusal | None]


def _source_cuts(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    source = source_of(world, call)
    return None if cuts(world.asset(source)) else refuse(FailureReason.NOT_A_SLICER, source=source)


def _sliceable(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    return None if is_sliceable(world.asset(target)) else refuse(FailureReason.NOT_SLICEABLE, target=target)


def _not_sliced(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    return refuse(FailureReason.ALREADY_SLICED, target=target) if world.is_sliced(target) else None


def _source_held(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    source = source_of(world, call)
    if source in world.carried[:1] or washing(world.asset(source)) is not None:
        return None
    return refuse(FailureReason.TOOL_NOT_HELD, source=source)


def _source_cleans(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    source = source_of(world, call)
    if is_cleaner(world.asset(source), world.facts_about(source)):
        return None
    return refuse(FailureReason.NOT_A_CLEANER, source=source)


def _worked_on(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    if washing(world.asset(source_of(world, call))) is not None:
        return None
    target = target_of(world, call)
    return out_of_reach(world, target) or hidden(world, target) or shut_in(world, target)


def _washed(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target, source = target_of(world, call), source_of(world, call)
    machine = washing(world.asset(source))
    if machine is None:
        return None
    if not world.is_inside(target, source):
        return refuse(FailureReason.NOT_AT_SOURCE, target=target, source=source, relation="inside")
    if not world.is_on(source):
        return refuse(FailureReason.SOURCE_OFF, source=source)
    if machine.requires_closed and world.is_open(source):
        return refuse(FailureReason.SOURCE_OPEN, source=source)
    return None


def _comes_off(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    """A clean object is no reason to refuse: running water cleans before it is asked to."""
    target, source = target_of(world, call), source_of(world, call)
    asset, covering = world.asset(source), coverings(world.facts_about(target))
    machine = washing(asset)
    if machine is not None:
        lacking = dict.fromkeys(covering) if not washed_away(machine, covering) else {}
    else:
        facts, on = world.facts_about(source), world.is_on(source)
        lacking = {name: missing_for(asset, facts, name, on=on) for name in covering}
    if not lacking or () in lacking.values():
        return None
    # What a change of the tool would help against is told before what it never takes off.
    substance, needed = next(
        ((name, needed) for name, needed in lacking.items() if needed), (covering[0], None)
    )
    if needed is None:
        return refuse(FailureReason.STAYS_ON, source=source, target=target, substance=word_of(substance))
    if RUNNING in needed:
        return refuse(FailureReason.SOURCE_OFF, source=source)
    return refuse(
        FailureReason.NEEDS_SOAKING,
        source=source,
        substance=word_of(substance),
        needed=" or ".join(map(word_of, needed)),
    )


def _source_wets(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    source = source_of(world, call)
    if gives_liquid(world.asset(source), world.facts_about(source)):
        return None
    return refuse(FailureReason.GIVES_NO_LIQUID, source=source)


def _soakable(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target = target_of(world, call)
    return None if soaks_up(world.asset(target)) else refuse(FailureReason.NOT_SOAKABLE, target=target)


def _source_accessible(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    return shut_in(world, source_of(world, call))


def _under_source(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    target, source = target_of(world, call), source_of(world, call)
    if (target in world.carried[:1] and target != source) or world.is_inside(target, source):
        return None
    return refuse(FailureReason.NOT_AT_SOURCE, target=target, source=source, relation="in the hand or inside")


def _source_flows(world: WorldView, call: SkillCall) -> SkillRefusal | None:
    source = source_of(world, call)
    given = liquids_given(world.asset(source), world.facts_about(source), on=world.is_on(source))
    return None if given else refuse(FailureReason.SOURCE_OFF, source=source)


HOUSEHOLD_CHECKS: Final[Mapping[Precondition, Check]] = {
    Precondition.SOURCE_CUTS: _source_cuts,
    Precondition.SLICEABLE: _sliceable,
    Precondition.NOT_SLICED: _not_sliced,
    Precondition.SOURCE_HELD: _source_held,
    Precondition.SOURCE_CLEANS: _source_cleans,
    Precondition.WORKED_ON: _worked_on,
    Precondition.WASHED: _washed,
    Precondition.COMES_OFF: _comes_off,
    Precondition.SOURCE_WETS: _source_wets,
    Precondition.SOAKABLE: _soakable,
    Precondition.SOURCE_ACCESSIBLE: _source_accessible,
    Precondition.UNDER_SOURCE: _under_source,
    Precondition.SOURCE_FLOWS: _source_flows,
}
"""How each of these preconditions is decided."""
