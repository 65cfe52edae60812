"""The taskset under a name of one word, as `vf-eval` looks for them: PYTHONPATH=docs/examples vf-eval embomatrix-household"""

from embomatrix.trainer.adapters.verifiers import HouseholdTaskset

__all__ = ["HouseholdTaskset"]
