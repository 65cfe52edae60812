"""Skills as tools: one method for each skill of a profile, with its arguments, described for a model."""

import inspect

import pytest

from embomatrix.envs.tools import TOOLS
from embomatrix.skills.episode_text import system_for_tools
from embomatrix.skills.syntax import PROFILES, SIGNATURES
from embomatrix.world.task import Profile


def tools_of(profile):
    members = inspect.getmembers(TOOLS[profile], inspect.isfunction)
    return {name: method for name, method in members if not name.startswith("_") and name != "reset"}


@pytest.mark.parametrize("profile", Profile)
def test_each_skill_of_a_profile_is_a_described_tool(profile):
    tools = tools_of(profile)
    assert set(tools) == {skill.value for skill in PROFILES[profile]}
    for skill in PROFILES[profile]:
        method = tools[skill.value]
        arguments = [argument.value for argument in SIGNATURES[skill]]
        assert list(inspect.signature(method).parameters)[1:] == arguments
        described = inspect.getdoc(method).split("Args:\n")[1].splitlines()
        assert [line.split(":")[0].strip() for line in described] == arguments


@pytest.mark.parametrize("profile", Profile)
def test_system_text_for_tools_asks_for_calls_and_lists_none(profile):
    text = system_for_tools(profile, seen=False)
    assert "call one tool at a time" in text
    assert "Actions" not in text
    assert ("tool in the hand" in text) == (profile is Profile.HOUSEHOLD)
    assert "You know only what the robot has seen" in system_for_tools(profile, seen=True)
