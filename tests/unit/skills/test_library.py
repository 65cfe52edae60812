"""The skill table is complete, and so is what hangs on it."""

from string import Formatter

from embomatrix.sim.actions import ACTIONS
from embomatrix.skills.check import CHECKS
from embomatrix.skills.describe import DONE
from embomatrix.skills.failure import SENTENCES, FailureReason
from embomatrix.skills.library import LIBRARY, MISHAPS, REASONS, Precondition, reasons_of
from embomatrix.skills.syntax import SIGNATURES, Arg, Skill


def test_every_skill_has_an_entry_a_signature_an_action_and_a_sentence():
    assert set(LIBRARY) == set(SIGNATURES) == set(ACTIONS) == set(DONE) == set(MISHAPS) == set(Skill)


def test_every_precondition_is_decided_has_reasons_and_is_asked_by_a_skill():
    assert set(CHECKS) == set(REASONS) == set(Precondition)
    assert {item for entry in LIBRARY.values() for item in entry.preconditions} == set(Precondition)


def test_every_reason_has_a_sentence_and_a_skill_that_can_give_it():
    assert set(SENTENCES) == set(FailureReason)
    assert frozenset().union(*(reasons_of(skill) for skill in Skill)) == set(FailureReason)


def test_only_outcomes_that_no_precondition_foresees_are_listed_beside_them_or_refine_one():
    for skill, entry in LIBRARY.items():
        foreseen = {reason for item in entry.preconditions for reason in REASONS[item]}
        assert set(entry.outcomes) - foreseen or not entry.outcomes, skill


def test_indices_and_rooms_are_looked_up_before_anything_else_is_asked():
    lookups = {
        Arg.OBJECT: Precondition.OBJECT_LISTED,
        Arg.SOURCE: Precondition.SOURCE_LISTED,
        Arg.ROOM: Precondition.ROOM_KNOWN,
    }
    for skill, entry in LIBRARY.items():
        wanted = [lookups[arg] for arg in SIGNATURES[skill] if arg in lookups]
        assert list(entry.preconditions[: len(wanted)]) == wanted, skill


def test_whatever_uses_a_thing_asks_for_reach_first_and_for_its_lid_then():
    for skill in (Skill.PICK_UP, Skill.PLACE, Skill.OPEN, Skill.CLOSE, Skill.TOGGLE_ON, Skill.TOGGLE_OFF):
        order = LIBRARY[skill].preconditions
        assert order.index(Precondition.IN_REACH) < order.index(Precondition.ACCESSIBLE)


def test_doors_switches_and_grasps_need_a_free_hand():
    asking = {skill for skill, entry in LIBRARY.items() if Precondition.HAND_FREE in entry.preconditions}
    assert asking == {Skill.PICK_UP, Skill.OPEN, Skill.CLOSE, Skill.TOGGLE_ON, Skill.TOGGLE_OFF}


def test_sentences_ask_for_named_values_only():
    for sentence in SENTENCES.values():
        assert all(field is None or field.isidentifier() for _, field, _, _ in Formatter().parse(sentence))


def test_every_entry_says_what_it_does_in_a_sentence():
    for entry in LIBRARY.values():
        assert entry.doc[0].isupper()
        assert entry.doc.endswith(".")
        assert entry.effect
