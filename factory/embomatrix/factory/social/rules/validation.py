"""Validation of a written request by rules, without a model and without a simulator."""

from collections.abc import Sequence

from embomatrix.factory.social.rules.faults import Fault
from embomatrix.factory.social.rules.instruction_rules import InstructionRules
from embomatrix.factory.social.rules.reading import read
from embomatrix.factory.social.rules.text_rules import text_faults
from embomatrix.factory.social.rules.wish_rules import wish_faults
from embomatrix.factory.social.scene_kinds import SceneKinds
from embomatrix.factory.social.values import Cast, DaySlot, Person
from embomatrix.factory.social.wish import Wish


def faults_of(
    instruction: str, wish: Wish, scene: SceneKinds, cast: Cast, slot: DaySlot
) -> tuple[Fault, ...]:
    """Return all rules that the request breaks. Text and wish come first, since the comparison depends on both."""
    alone = (*text_faults(instruction, frozenset(cast.names)), *wish_faults(wish, scene))
    if alone:
        return alone
    person = cast.of(slot.person)
    reading = read(instruction, _context(cast.people, slot))
    own_rooms = frozenset((slot.room, *person.rooms))
    return InstructionRules(reading, wish, scene, own_rooms).faults()


def _context(people: Sequence[Person], slot: DaySlot) -> tuple[str, ...]:
    """Return phrases about the people that state no demand: names, jobs, hobbies and the activity of the slot."""
    about = (text for person in people for text in (person.name, person.job, person.hobby))
    return (slot.activity, *about)
