"""Episodes in Python: ``make`` opens an environment over the tasks of a dataset."""

from embomatrix.envs.environment import Environment, PlayedEpisode
from embomatrix.envs.opening import make
from embomatrix.envs.player import Observation
from embomatrix.envs.rules import EpisodeEnd, EpisodeReward, EpisodeRules, Visibility

__all__ = [
    "Environment",
    "EpisodeEnd",
    "EpisodeReward",
    "EpisodeRules",
    "Observation",
    "PlayedEpisode",
    "Visibility",
    "make",
]
