"""EAI's hundred goals: the reachable ones by profile, and the predicates that block the others."""

import collections
import re

import pytest

from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.factory.task_import.likeness import like_eai
from embomatrix.factory.task_import.reach import unreachable_atoms
from embomatrix.factory.task_import.sources import LIKE_EAI, read_eai
from embomatrix.trainer.eai.environment import install
from embomatrix.world.task import Profile

WORD = re.compile(r"\((not \()?([a-z]\w*)")
pytestmark = [pytest.mark.eai, pytest.mark.timeout(900)]


@pytest.fixture(scope="module")
def sources():
    return read_eai(install().package_root)


@pytest.fixture(scope="module")
def problems(sources):
    return {source.name: read_problem(source)[0] for source in sources}


def blocking(problems, profile):
    """Count the goals that each set of predicates blocks."""
    found = {name: unreachable_atoms(problem, profile) for name, problem in problems.items()}
    blockers = []
    for atoms in filter(None, found.values()):
        literals = WORD.findall(" ".join(atoms))
        blockers.append(", ".join(sorted({"not " * bool(negated) + word for negated, word in literals})))
    return dict(collections.Counter(blockers))


def test_fifty_nine_goals_are_within_the_paper_s_skills_and_ninety_nine_within_the_household_s(problems):
    assert blocking(problems, Profile.PAPER) == {
        "not dusty": 11,
        "not stained": 11,
        "not dusty, not stained": 8,
        "sliced": 4,
        "not stained, soaked": 3,
        "soaked": 2,
        "not dusty, soaked": 1,
        "sliced, soaked": 1,
    }
    assert blocking(problems, Profile.HOUSEHOLD) == {"sliced": 1}
    assert unreachable_atoms(problems["chopping_vegetables"], Profile.HOUSEHOLD) == (
        "(sliced ?chestnut.n.03)",
    )


def test_activities_with_goals_like_those_of_eai_are_the_ones_that_imports_hold_out(sources):
    assert like_eai(sources) == LIKE_EAI
