"""The skill table and the tables that depend on it are complete."""

from string import Formatter

from tests.fakes.skill_reasons import MISHAPS, reasons_of

from embomatrix.sim.actions import ACTIONS
from embomatrix.skills.check import RULES
from embomatrix.skills.describe import DONE
from embomatrix.skills.failure import FailureReason
from embomatrix.skills.library import LIBRARY, Precondition
from embomatrix.skills.syntax import SIGNATURES, Arg, Skill


def test_every_skill_has_a_definition_signature_action_and_message():
    assert set(LIBRARY) == set(SIGNATURES) == set(ACTIONS) == set(DONE) == set(MISHAPS) == set(Skill)


def test_every_precondition_has_a_rule_and_is_used_by_a_skill():
    assert set(RULES) == set(Precondition)
    assert {item for entry in LIBRARY.values() for item in entry.preconditions} == set(Precondition)


def test_every_failure_reason_has_a_sentence_and_a_skill_that_reports_it():
    assert all(reason.sentence for reason in FailureReason)
    assert frozenset().union(*(reasons_of(skill) for skill in Skill)) == set(FailureReason)


def test_outcomes_add_reasons_that_no_precondition_reports():
    for skill, entry in LIBRARY.items():
        foreseen = {reason for item in entry.preconditions for reason in RULES[item].reasons}
        assert set(entry.outcomes) - foreseen or not entry.outcomes, skill


def test_indices_and_rooms_are_checked_first():
    lookups = {
        Arg.OBJECT: Precondition.OBJECT_LISTED,
        Arg.SOURCE: Precondition.SOURCE_LISTED,
        Arg.ROOM: Precondition.ROOM_KNOWN,
    }
    for skill, entry in LIBRARY.items():
        wanted = [lookups[arg] for arg in SIGNATURES[skill] if arg in lookups]
        assert list(entry.preconditions[: len(wanted)]) == wanted, skill


def test_reach_is_checked_before_closed_containers():
    for skill in (Skill.PICK_UP, Skill.PLACE, Skill.OPEN, Skill.CLOSE, Skill.TOGGLE_ON, Skill.TOGGLE_OFF):
        order = LIBRARY[skill].preconditions
        assert order.index(Precondition.IN_REACH) < order.index(Precondition.ACCESSIBLE)


def test_doors_switches_and_grasps_need_a_free_hand():
    asking = {skill for skill, entry in LIBRARY.items() if Precondition.HAND_FREE in entry.preconditions}
    assert asking == {Skill.PICK_UP, Skill.OPEN, Skill.CLOSE, Skill.TOGGLE_ON, Skill.TOGGLE_OFF}


def test_sentences_use_named_fields_only():
    for sentence in (reason.sentence for reason in FailureReason):
        assert all(field is None or field.isidentifier() for _, field, _, _ in Formatter().parse(sentence))


def test_every_definition_states_its_effect():
    for entry in LIBRARY.values():
        assert entry.effect
