"""Ways to make a goal true are enough for it, and those that change least come first."""

from dataclasses import dataclass

from hypothesis import given
from hypothesis import strategies as st

from embomatrix.sim.planner.choices import choices
from embomatrix.world.evaluate import evaluate
from embomatrix.world.goal import (
    And,
    Atom,
    Exists,
    Forall,
    ForN,
    ForNPairs,
    ForPairs,
    Imply,
    Not,
    Or,
)

TYPES = {"cup": ("cup_1", "cup_2", "cup_3"), "tray": ("tray_1", "tray_2")}


@dataclass(frozen=True)
class Table:
    """Facts by enumeration."""

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


def test_a_conjunction_asks_for_all_of_its_parts():
    assert first(And((hot("cup_1"), Not(hot("cup_2"))))) == {"hot cup_1", "not hot cup_2"}


def test_things_go_onto_what_stays_rather_than_onto_one_another():
    anywhere = [Or((on(cup, "cup_1"), on(cup, "cup_2"), on(cup, "tray_1"))) for cup in TYPES["cup"]]
    assert first(And(tuple(anywhere))) == {f"ontop {cup} tray_1" for cup in TYPES["cup"]}


def test_of_a_disjunction_the_part_that_holds_comes_first():
    assert first(Or((hot("cup_1"), hot("cup_2"))), hot("cup_2")) == {"hot cup_2"}


def test_an_implication_is_kept_by_doing_without_its_premise():
    assert first(Imply(hot("cup_1"), hot("cup_2"))) == {"not hot cup_1"}


def test_forall_asks_for_every_member_and_its_negation_for_one():
    assert first(Forall("?c", "cup", hot("?c"))) == {"hot cup_1", "hot cup_2", "hot cup_3"}
    assert first(Not(Forall("?c", "cup", hot("?c"))), hot("cup_1"), hot("cup_2")) == {"not hot cup_3"}


def test_exists_chooses_the_member_that_is_nearly_there():
    goal = Exists("?c", "cup", And((hot("?c"), on("?c", "tray_1"))))
    assert first(goal, hot("cup_3")) == {"hot cup_3", "ontop cup_3 tray_1"}


def test_exactly_n_asks_the_others_to_stay_out():
    goal = ForN(1, "?c", "cup", on("?c", "tray_1"))
    assert first(goal, on("cup_2", "tray_1")) == {
        "ontop cup_2 tray_1",
        "not ontop cup_1 tray_1",
        "not ontop cup_3 tray_1",
    }


def test_pairs_use_every_tray_once():
    chosen = first(ForPairs("?c", "cup", "?t", "tray", on("?c", "?t")), on("cup_2", "tray_1"))
    assert len(chosen) == 2
    assert "ontop cup_2 tray_1" in chosen


def test_n_pairs_use_as_many_as_are_asked_for():
    assert len(first(ForNPairs(1, "?c", "cup", "?t", "tray", on("?c", "?t")))) == 1


def test_a_goal_that_contradicts_itself_has_no_way():
    assert choices(And((hot("cup_1"), Not(hot("cup_1")))), TYPES, Table()) == ()


ATOMS = st.builds(hot, st.sampled_from(TYPES["cup"])) | st.builds(
    on, st.sampled_from(TYPES["cup"]), st.sampled_from(TYPES["tray"])
)
QUANTIFIED = st.sampled_from(
    [
        Forall("?c", "cup", hot("?c")),
        Exists("?c", "cup", on("?c", "tray_1")),
        ForN(2, "?c", "cup", hot("?c")),
        ForPairs("?c", "cup", "?t", "tray", on("?c", "?t")),
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
def test_a_world_in_which_a_choice_holds_is_one_in_which_the_goal_does(goal, true):
    for choice in choices(goal, TYPES, Table(true)):
        asked = frozenset(item.atom for item in choice if item.positive)
        denied = frozenset(item.atom for item in choice if not item.positive)
        assert evaluate(goal, Table((true | asked) - denied), TYPES)


@given(goal=GOALS, true=st.frozensets(ATOMS))
def test_a_goal_that_holds_has_a_way_that_changes_nothing_unless_it_denies_pairs(goal, true):
    facts = Table(true)
    found = choices(goal, TYPES, facts)
    costs = [sum(facts.holds(i.atom.predicate, i.atom.args) != i.positive for i in c) for c in found]
    assert costs == sorted(costs)
