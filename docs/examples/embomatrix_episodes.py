"""Module that `vf-eval` imports by environment name: PYTHONPATH=docs/examples vf-eval embomatrix-episodes"""

from embomatrix.envs.verifiers import EpisodesEnv, EpisodesTaskset

__all__ = ["EpisodesEnv", "EpisodesTaskset"]
