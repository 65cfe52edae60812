"""Choices are sufficient for their goal, and those that change least come first."""

from dataclasses import dataclass

from hypothesis import given
from hypothesis import strategies as st
from tests.fakes.formulas import exists, forall, forn, forpairs

from embomatrix.sim.planner.choices import choices
from embomatrix.world.evaluate import evaluate
from embomatrix.world.goal import And, Atom, Imply, Not, Or

TYPES = {"cup": ("cup_1", "cup_2", "cup_3"), "tray": ("tray_1", "tray_2")}


@dataclass(frozen=True)
class Table:
    """Facts given by enumeration."""

    true: frozenset[Atom] = frozenset()

    def holds(self, predicate, args):
        return Atom(predicate, args) in self.true


def hot(name):
    return Atom("hot", (name,))


def on(cup, tray):
    return Atom("ontop", (cup, tray))


def as_texts(choice):
    return {
        f"{'' if item.positive else 'not '}{item.atom.predicate} {' '.join(item.atom.args)}"
        for item in choice
    }


def first(goal, *true):
    return as_texts(choices(goal, TYPES, Table(frozenset(true)))[0])


def test_conjunction_requires_all_of_its_parts():
    assert first(And((hot("cup_1"), Not(hot("cup_2"))))) == {"hot cup_1", "not hot cup_2"}


def test_objects_go_onto_fixed_objects_rather_than_onto_each_other():
    anywhere = [Or((on(cup, "cup_1"), on(cup, "cup_2"), on(cup, "tray_1"))) for cup in TYPES["cup"]]
    assert first(And(tuple(anywhere))) == {f"ontop {cup} tray_1" for cup in TYPES["cup"]}


def test_true_part_of_a_disjunction_comes_first():
    assert first(Or((hot("cup_1"), hot("cup_2"))), hot("cup_2")) == {"hot cup_2"}


def test_implication_is_satisfied_by_a_false_premise():
    assert first(Imply(hot("cup_1"), hot("cup_2"))) == {"not hot cup_1"}


def test_forall_requires_every_member_and_its_negation_one():
    assert first(forall("?c", "cup", hot("?c"))) == {"hot cup_1", "hot cup_2", "hot cup_3"}
    assert first(Not(forall("?c", "cup", hot("?c"))), hot("cup_1"), hot("cup_2")) == {"not hot cup_3"}


def test_exists_prefers_the_member_with_fewest_changes():
    goal = exists("?c", "cup", And((hot("?c"), on("?c", "tray_1"))))
    assert first(goal, hot("cup_3")) == {"hot cup_3", "ontop cup_3 tray_1"}


def test_exactly_n_excludes_the_other_members():
    goal = forn(1, "?c", "cup", on("?c", "tray_1"))
    assert first(goal, on("cup_2", "tray_1")) == {
        "ontop cup_2 tray_1",
        "not ontop cup_1 tray_1",
        "not ontop cup_3 tray_1",
    }


def test_pairs_use_every_tray_once():
    chosen = first(forpairs("?c", "cup", "?t", "tray", on("?c", "?t")), on("cup_2", "tray_1"))
    assert len(chosen) == 2
    assert "ontop cup_2 tray_1" in chosen


def test_n_pairs_use_the_requested_number():
    assert len(first(forpairs("?c", "cup", "?t", "tray", on("?c", "?t"), 1))) == 1


def test_contradictory_goal_has_no_choice():
    assert choices(And((hot("cup_1"), Not(hot("cup_1")))), TYPES, Table()) == ()


ATOMS = st.builds(hot, st.sampled_from(TYPES["cup"])) | st.builds(
    on, st.sampled_from(TYPES["cup"]), st.sampled_from(TYPES["tray"])
)
QUANTIFIED = st.sampled_from(
    [
        forall("?c", "cup", hot("?c")),
        exists("?c", "cup", on("?c", "tray_1")),
        forn(2, "?c", "cup", hot("?c")),
        forpairs("?c", "cup", "?t", "tray", on("?c", "?t")),
    ]
)
GOALS = st.recursive(
    ATOMS | QUANTIFIED,
    lambda inner: (
        st.builds(Not, inner)
        | st.builds(Imply, inner, inner)
        | st.lists(inner, min_size=1, max_size=3).map(lambda parts: And(tuple(parts)))
        | st.lists(inner, min_size=1, max_size=3).map(lambda parts: Or(tuple(parts)))
    ),
    max_leaves=6,
)


@given(goal=GOALS, true=st.frozensets(ATOMS))
def test_goal_holds_in_every_world_that_satisfies_a_choice(goal, true):
    for choice in choices(goal, TYPES, Table(true)):
        asked = frozenset(item.atom for item in choice if item.positive)
        denied = frozenset(item.atom for item in choice if not item.positive)
        assert evaluate(goal, Table((true | asked) - denied), TYPES)


@given(goal=GOALS, true=st.frozensets(ATOMS))
def test_true_goal_has_a_choice_without_changes_unless_it_negates_pairs(goal, true):
    facts = Table(true)
    found = choices(goal, TYPES, facts)
    costs = [sum(facts.holds(i.atom.predicate, i.atom.args) != i.positive for i in c) for c in found]
    assert costs == sorted(costs)
