"""The three reward tiers with the paper's constants."""

from collections.abc import Mapping

import pytest
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.reward.hierarchy import score, unparsable
from embomatrix.reward.settings import RewardSettings, RewardSettingsError
from embomatrix.world.bddl import parse_formula
from embomatrix.world.task import Task, TaskCategory

NAMES = tuple(f"apple_{number}" for number in range(8))
TYPES: Mapping[str, tuple[str, ...]] = {"apple": NAMES, "box": ("box_1",)}


class Inside:
    """Facts in which the given apples are inside the box."""

    def __init__(self, *names: str) -> None:
        self.names = names

    def holds(self, predicate: str, args: tuple[str, ...]) -> bool:
        return predicate == "inside" and args[0] in self.names and args[1] == "box_1"


def task(goal: str) -> Task:
    objects = {name: key for key, names in TYPES.items() for name in names}
    formula = parse_formula(goal, objects)
    return Task("t", "s", "", TaskCategory.PICK_AND_PLACE, formula, goal, tuple(objects), TYPES)


TWO = task("(and (inside apple_0 box_1) (inside apple_1 box_1))")


def test_unparsable_text_earns_minus_one() -> None:
    assert unparsable().total == -1.0
    assert not unparsable().success


def test_plan_without_effect_earns_only_the_format_reward() -> None:
    breakdown = score(TWO, frozenset(), Inside())
    assert (breakdown.format, breakdown.relevance, breakdown.goal) == (0.5, 0.0, 0.0)
    assert breakdown.total == 0.5


def test_full_success_earns_every_tier() -> None:
    breakdown = score(TWO, frozenset({"apple_0", "apple_1", "box_1"}), Inside("apple_0", "apple_1"))
    assert breakdown.total == pytest.approx(0.5 + 0.6 + 30.0)
    assert breakdown.success


def test_each_atom_earns_its_equal_share() -> None:
    breakdown = score(TWO, frozenset(), Inside("apple_1"))
    assert breakdown.goal == pytest.approx(15.0)
    assert [(atom.text, atom.holds) for atom in breakdown.atoms] == [
        ("(inside apple_0 box_1)", False),
        ("(inside apple_1 box_1)", True),
    ]
    assert not breakdown.success


def test_relevance_counts_only_goal_objects() -> None:
    assert score(TWO, frozenset({"apple_5", "apple_0"}), Inside()).relevance == pytest.approx(0.2)


def test_relevance_is_capped_at_one() -> None:
    every = task("(forall (?x - apple) (inside ?x box_1))")
    assert score(every, frozenset({*NAMES, "box_1"}), Inside()).relevance == 1.0


def test_members_of_a_quantified_type_are_goal_objects() -> None:
    some = task("(exists (?x - apple) (inside ?x box_1))")
    breakdown = score(some, frozenset({"apple_3"}), Inside("apple_3"))
    assert breakdown.total == pytest.approx(0.5 + 0.2 + 30.0)
    assert len(breakdown.atoms) == 1


def test_settings_override_every_constant() -> None:
    settings = RewardSettings(unparsable=-2.0, format=1.0, relevance_per_object=0.5, goal=10.0)
    assert unparsable(settings).total == -2.0
    assert score(TWO, frozenset({"box_1"}), Inside("apple_0"), settings).total == pytest.approx(
        1.0 + 0.5 + 5.0
    )


@pytest.mark.parametrize(
    ("coefficients", "sentence"),
    [
        ({"goal": -3.0}, r"goal: found -3: expected 0 or more; 0 disables the tier"),
        ({"relevance_limit": float("nan")}, r"relevance_limit: found nan: expected a number between"),
        ({"format": 1e9}, r"format: found 1e\+09: expected a number between -1e6 and 1e6"),
        ({"unparsable": 1.0}, r"unparsable: found 1 with format 0\.5: .* lower it"),
    ],
)
def test_invalid_coefficients_are_named(coefficients: dict[str, float], sentence: str) -> None:
    with pytest.raises(RewardSettingsError, match=sentence):
        RewardSettings(**coefficients)


@given(st.frozensets(st.sampled_from([*NAMES, "box_1"])), st.frozensets(st.sampled_from(NAMES)))
def test_executed_plan_earns_between_format_reward_and_maximum(
    touched: frozenset[str], inside: frozenset[str]
) -> None:
    every = task("(forall (?x - apple) (inside ?x box_1))")
    breakdown = score(every, touched, Inside(*inside))
    assert 0.5 <= breakdown.total <= 31.5
    assert breakdown.total == pytest.approx(
        0.5 + min(1.0, 0.2 * len(touched)) + 30.0 / len(NAMES) * len(inside)
    )
    assert breakdown.success is (len(inside) == len(NAMES))
