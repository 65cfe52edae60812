"""The oracle planner finds a plan wherever breadth-first search over executed calls finds one."""

import pytest
from tests.fakes.search import compare

GOALS = 10
SCENES = 10
KNOWN = "(and (not (touching bowl_1 chicken_leg_1)) (open fridge_1) (ontop bowl_1 shelf_1))"
"""Goal of scene 0 that the oracle misses: with one seed the bowl comes to stand beside the chicken leg, and it tries no other
place."""


def test_oracle_solves_tasks_that_search_solves_in_two_small_scenes():
    comparisons = [compare(number, GOALS, limit=120) for number in range(2)]
    assert sum(each.found for each in comparisons) >= GOALS
    assert not [missed for each in comparisons for missed in each.missed if KNOWN not in missed]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_oracle_solves_98_percent_of_small_tasks_that_search_solves(capsys):
    found, missed = 0, []
    for number in range(SCENES):
        comparison = compare(number, GOALS, limit=700)
        found += comparison.found
        missed += comparison.missed
    with capsys.disabled():
        print(f"\n{SCENES * GOALS} tasks: search solves {found}, the oracle {found - len(missed)} of those")
    assert found >= 0.7 * SCENES * GOALS
    assert len(missed) <= 0.02 * found, "\n".join(missed)
