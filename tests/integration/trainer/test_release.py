"""A finished run's policy is released without its state of training, and the shipped one loads like any other."""

import pytest
import torch
from tests.integration.trainer.test_loop import TASKS, run, weights

from embomatrix.starter.shipped import SHIPPED, shipped_policy
from embomatrix.trainer.config.errors import TrainerError
from embomatrix.trainer.evaluation.models import load_model
from embomatrix.trainer.lifecycle.checkpoint import newest_checkpoint, read_state
from embomatrix.trainer.logging.outcome import read_outcome
from embomatrix.trainer.run.release import CARD, card_of, release


def test_released_policy_is_the_trained_one_with_a_card(tmp_path):
    summary, trained = run(tmp_path / "run")
    folder = release(tmp_path / "run", tmp_path / "out", "embomatrix train --seed 3")
    assert sorted(path.name for path in folder.iterdir()) == [CARD, "policy", "state.json"]
    policy, settings = load_model(str(folder), None, threads=1, device="cpu")
    assert torch.equal(weights(policy), weights(trained))
    assert settings.grpo.steps == 6
    card = (folder / CARD).read_text()
    assert "`embomatrix train --seed 3`: 60 steps of imitation and 6 of GRPO" in card
    assert f"| all | {len(TASKS.heldout)} | {summary.before.success().as_percent()} |" in card
    assert not list(folder.rglob("*.partial*"))


def test_card_of_a_language_model_names_the_weights_that_it_began_with(tmp_path):
    run(tmp_path / "run")
    outcome = read_outcome(tmp_path / "run")
    progress, settings = read_state(newest_checkpoint(tmp_path / "run"))
    card = card_of(
        outcome, progress, settings.model_copy(update={"model": "org/model"}), "train", "2026-11-28"
    )
    assert card.startswith("# A language model for household plans")
    assert "Trained from `org/model`, whose licence holds for these weights too." in card
    assert "MIT" not in card


def test_release_replaces_nothing_and_wants_a_finished_run(tmp_path):
    (tmp_path / "mine").mkdir()
    with pytest.raises(TrainerError, match="mine exists: give a new folder, or remove it"):
        release(tmp_path / "run", tmp_path / "mine", "")
    with pytest.raises(TrainerError, match=r"outcome\.json is not the outcome of a finished run"):
        release(tmp_path / "run", tmp_path / "out", "")


def test_shipped_policy_loads_and_its_card_says_what_it_is():
    policy, settings = load_model(SHIPPED, None, threads=1, device="cpu")
    assert sum(parameter.numel() for parameter in policy.parameters()) > 500_000
    assert settings.model == "tiny"
    card = (shipped_policy() / CARD).read_text()
    assert "embomatrix demo --seed 0" in card
    assert "| all | 200 |" in card
