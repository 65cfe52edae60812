"""Module that `vf-eval` imports by environment name: PYTHONPATH=docs/examples vf-eval embomatrix-household"""

from embomatrix.trainer.adapters.verifiers import HouseholdTaskset

__all__ = ["HouseholdTaskset"]
