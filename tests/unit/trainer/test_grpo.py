"""Group relative policy optimisation against the formulas in plain Python."""

import itertools
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from embomatrix.trainer.config.settings import GrpoSettings, LossKind, RatioLevel
from embomatrix.trainer.learning.objective import (
    LossInputs,
    LossTotals,
    group_advantages,
    surrogate_loss,
)

LOST = math.nan
REWARD = st.one_of(st.floats(-1, 32), st.just(LOST), st.sampled_from([-1.0, 0.5, 31.5]))
GROUPS = st.integers(2, 8).flatmap(
    lambda size: st.lists(st.lists(REWARD, min_size=size, max_size=size), min_size=1, max_size=4)
)

NEW = [[-1.0, -0.5], [-2.0, -1.0], [-0.3, -0.7], [-1.2, -0.1]]
OLD = [[-1.1, -0.9], [-1.5, -1.0], [-0.3, -0.2], [-1.2, -0.6]]
SAMPLER = [[-1.9, -0.4], [-1.5, -1.3], [-0.6, -0.2], [-3.0, -0.5]]
REFERENCE = [[-1.0, -0.6], [-1.8, -1.1], [-0.5, -0.7], [-1.0, -0.4]]
MASK = [[True, True], [True, False], [True, True], [True, True]]
ADVANTAGES = [1.0, -1.0, 0.5, -0.5]


def inputs(new=NEW, **changes):
    values = {
        "logprobs": torch.tensor(new, dtype=torch.float64, requires_grad=True),
        "old_logprobs": torch.tensor(OLD, dtype=torch.float64),
        "mask": torch.tensor(MASK),
        "advantages": torch.tensor(ADVANTAGES, dtype=torch.float64)[:, None],
        "reference": torch.tensor(REFERENCE, dtype=torch.float64),
    }
    return LossInputs(**{**values, **changes})


def settings_of(**changes):
    return GrpoSettings(**{"kl_coef": 0.0, **changes})


LONGEST = 5
TOTALS = LossTotals(4, 7, LONGEST)


def ratios(new, old, own, level):
    """Return the importance ratio at each of a plan's own tokens."""
    gaps = [new[at] - old[at] for at in own]
    if level is RatioLevel.TOKEN:
        return [math.exp(gap) for gap in gaps]
    return [math.exp(sum(gaps) / (len(gaps) if level is RatioLevel.MEAN else 1))] * len(gaps)


def by_hand(kind, ratio, low, high, kl_coef, cap=None):
    """Compute the objective in plain Python, plan by plan and token by token. ``cap`` truncates the sampler's weights."""
    plans = []
    level = RatioLevel.MEAN if kind is LossKind.GSPO else ratio
    rows = zip(NEW, OLD, SAMPLER, REFERENCE, MASK, ADVANTAGES, strict=True)
    for new, old, sampler, reference, mask, advantage in rows:
        own = [at for at, present in enumerate(mask) if present]
        weights = ratios(old, sampler, own, level)
        tokens = []
        for at, rho, weight in zip(own, ratios(new, old, own, level), weights, strict=True):
            gain = min(rho * advantage, min(max(rho, 1 - low), 1 + high) * advantage)
            gain *= 1 if cap is None else min(weight, cap)
            gap = reference[at] - new[at]
            tokens.append((gain, kl_coef * (math.exp(gap) - gap - 1)))
        plans.append(tokens)
    if kind is LossKind.PAPER:
        gains = [
            plan[0][0] if ratio is not RatioLevel.TOKEN else sum(gain for gain, _ in plan) for plan in plans
        ]
        return (sum(cost for plan in plans for _, cost in plan) - sum(gains)) / len(plans)
    if kind in (LossKind.GRPO, LossKind.GSPO):
        return sum(sum(cost - gain for gain, cost in plan) / len(plan) for plan in plans) / len(plans)
    total = sum(cost - gain for plan in plans for gain, cost in plan)
    return total / (len(plans) * LONGEST if kind is LossKind.DR_GRPO else sum(map(len, plans)))


@pytest.mark.parametrize(("kind", "ratio"), list(itertools.product(LossKind, RatioLevel)))
def test_loss_equals_the_formula(kind, ratio):
    settings = settings_of(loss=kind, ratio=ratio, kl_coef=0.1)
    loss, _ = surrogate_loss(inputs(), settings, TOTALS)
    assert loss.item() == pytest.approx(by_hand(kind, ratio, 0.2, 0.28, 0.1), abs=1e-12)


@pytest.mark.parametrize(("kind", "ratio"), list(itertools.product(LossKind, RatioLevel)))
def test_truncated_importance_sampling_equals_the_formula(kind, ratio):
    settings = settings_of(loss=kind, ratio=ratio, kl_coef=0.1, overlap="ahead", truncate_ratio=1.3)
    sampler = torch.tensor(SAMPLER, dtype=torch.float64)
    loss, metrics = surrogate_loss(inputs(sampler_logprobs=sampler), settings, TOTALS)
    assert loss.item() == pytest.approx(by_hand(kind, ratio, 0.2, 0.28, 0.1, cap=1.3), abs=1e-12)
    assert metrics.kl_to_old != surrogate_loss(inputs(), settings, TOTALS)[1].kl_to_old


def test_sampler_gap_is_the_difference_of_log_probabilities_over_unmasked_tokens():
    exact = surrogate_loss(
        inputs(sampler_logprobs=torch.tensor(OLD, dtype=torch.float64)), settings_of(), TOTALS
    )[1]
    assert (exact.sampler_gap, exact.sampler_gap_max) == (0, 0)
    sampler = torch.tensor(SAMPLER, dtype=torch.float64)
    given = inputs(sampler_logprobs=sampler)
    gaps = (given.old_logprobs - sampler).abs()[given.mask.bool()]
    metrics = surrogate_loss(given, settings_of(), TOTALS)[1]
    assert metrics.sampler_gap == pytest.approx(float(gaps.mean()))
    assert metrics.sampler_gap_max == pytest.approx(float(gaps.max()))
    assert metrics.sampler_gap > 0


def test_truncated_weights_keep_the_gradient_that_the_clipped_ratio_drops():
    good = torch.ones(4, 1, dtype=torch.float64)
    sampler = torch.tensor(OLD, dtype=torch.float64) - 1  # the policy has become e times as sure
    clipped = inputs(new=OLD, old_logprobs=sampler, reference=None, advantages=good)
    surrogate_loss(clipped, settings_of(), TOTALS)[0].backward()
    assert clipped.logprobs.grad.abs().max() == 0
    weighted = inputs(new=OLD, sampler_logprobs=sampler, reference=None, advantages=good)
    plain = inputs(new=OLD, reference=None, advantages=good)
    surrogate_loss(weighted, settings_of(overlap="ahead", truncate_ratio=2.0), TOTALS)[0].backward()
    surrogate_loss(plain, settings_of(), TOTALS)[0].backward()
    assert torch.allclose(weighted.logprobs.grad, 2 * plain.logprobs.grad)


def test_paper_objective_equals_its_golden_value():
    settings = settings_of(loss=LossKind.PAPER, ratio=RatioLevel.SEQUENCE, clip_high=0.2, kl_coef=0.1)
    # ratios exp(0.5), exp(-0.5), exp(-0.5), exp(0.5); clipped at 1.2 and 0.8 where that lowers the gain
    gain = (1.2 - 0.8 + 0.5 * math.exp(-0.5) - 0.5 * math.exp(0.5)) / 4
    loss, _ = surrogate_loss(inputs(reference=None), settings, TOTALS)
    assert loss.item() == pytest.approx(-gain, abs=1e-12)


@pytest.mark.parametrize(("kind", "ratio"), list(itertools.product(LossKind, RatioLevel)))
def test_microbatches_add_up_to_the_step(kind, ratio):
    settings = settings_of(loss=kind, ratio=ratio, kl_coef=0.05, entropy_coef=0.01)
    entropy = torch.full((4, 2), 0.3, dtype=torch.float64)
    whole = inputs(entropy=entropy)
    loss, _ = surrogate_loss(whole, settings, TOTALS)
    loss.backward()
    pieces = inputs(entropy=entropy)
    for rows in (slice(0, 2), slice(2, 4)):
        part = LossInputs(
            pieces.logprobs[rows],
            pieces.old_logprobs[rows],
            pieces.mask[rows],
            pieces.advantages[rows],
            pieces.reference[rows],
            entropy[rows],
        )
        surrogate_loss(part, settings, TOTALS)[0].backward()
    assert torch.allclose(whole.logprobs.grad, pieces.logprobs.grad)


@pytest.mark.parametrize(("kind", "ratio"), list(itertools.product(LossKind, RatioLevel)))
def test_tokens_with_the_advantage_of_their_plan_have_its_loss(kind, ratio):
    settings = settings_of(loss=kind, ratio=ratio, kl_coef=0.05)
    of_plans, of_tokens = inputs(), inputs(advantages=inputs().advantages.expand(4, 2))
    expected, _ = surrogate_loss(of_plans, settings, TOTALS)
    found, _ = surrogate_loss(of_tokens, settings, TOTALS)
    expected.backward()
    found.backward()
    assert found.item() == pytest.approx(expected.item(), abs=1e-12)
    assert torch.allclose(of_tokens.logprobs.grad, of_plans.logprobs.grad)


@pytest.mark.parametrize("ratio", RatioLevel)
def test_each_token_follows_its_own_advantage(ratio):
    signs = torch.tensor([[1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]], dtype=torch.float64)
    start = inputs(new=OLD, reference=None, advantages=signs)
    surrogate_loss(start, settings_of(ratio=ratio), TOTALS)[0].backward()
    slopes = -start.logprobs.grad
    if ratio is RatioLevel.TOKEN:
        assert torch.equal(torch.sign(slopes)[start.mask], signs[start.mask])
    else:  # one ratio for the plan: its tokens move by the sum of their advantages
        assert torch.allclose(slopes[0], torch.zeros(2, dtype=torch.float64))
        assert (slopes[3] < 0).all()


@pytest.mark.parametrize(("kind", "ratio"), list(itertools.product(LossKind, RatioLevel)))
def test_gradient_raises_good_plans_and_lowers_bad_ones(kind, ratio):
    start = inputs(new=OLD, reference=None)
    loss, metrics = surrogate_loss(start, settings_of(loss=kind, ratio=ratio), TOTALS)
    loss.backward()
    for row, advantage in enumerate(ADVANTAGES):
        for at, own in enumerate(MASK[row]):
            slope = -start.logprobs.grad[row, at].item()
            assert math.copysign(1, slope) == math.copysign(1, advantage) if own else slope == 0
    assert metrics.clip_fraction == 0
    assert metrics.kl_to_old == pytest.approx(0)


def test_clipped_ratio_has_no_gradient():
    far = inputs(new=[[0.9, 0.9]] * 4, reference=None, advantages=torch.ones(4, 1, dtype=torch.float64))
    loss, metrics = surrogate_loss(far, settings_of(), TOTALS)
    loss.backward()
    assert far.logprobs.grad.abs().max() == 0
    assert metrics.clip_fraction == 1


def test_lost_rows_have_no_influence():
    mask = torch.tensor(MASK)
    mask[2] = False
    part = inputs(mask=mask)
    loss, _ = surrogate_loss(
        part, settings_of(loss=LossKind.PAPER, ratio=RatioLevel.SEQUENCE, kl_coef=0.1), TOTALS
    )
    loss.backward()
    assert part.logprobs.grad[2].abs().max() == 0


def test_kl_term_pulls_towards_the_reference():
    part = inputs(new=OLD, advantages=torch.zeros(4, 1, dtype=torch.float64))
    loss, metrics = surrogate_loss(part, settings_of(kl_coef=1.0), TOTALS)
    loss.backward()
    own = torch.tensor(MASK)
    wanted = torch.sign(torch.tensor(REFERENCE) - torch.tensor(OLD))[own]
    assert torch.equal(torch.sign(-part.logprobs.grad)[own].float(), wanted)
    assert metrics.kl_to_reference > 0


@pytest.mark.parametrize("reward", [0.1, 0.7, 30.3, 31.2])
@pytest.mark.parametrize("size", [3, 5, 7, 16])
def test_equal_rewards_have_no_spread_however_their_mean_is_rounded(reward, size):
    result = group_advantages(torch.full((1, size), reward))
    assert result.zero_variance.all()
    assert not result.values.any()


def test_metrics_tell_the_direction_of_each_divergence():
    part = inputs()
    metrics = surrogate_loss(part, settings_of(kl_coef=0.1), TOTALS)[1]
    own = torch.tensor(MASK)
    new, old = torch.tensor(NEW, dtype=torch.float64)[own], torch.tensor(OLD, dtype=torch.float64)[own]
    reference = torch.tensor(REFERENCE, dtype=torch.float64)[own]
    assert metrics.kl_to_old == pytest.approx(float(((new - old).exp() - (new - old) - 1).mean()))
    away = reference - new
    assert metrics.kl_to_reference == pytest.approx(float((away.exp() - away - 1).mean()))
    assert surrogate_loss(inputs(reference=None), settings_of(), TOTALS)[1].kl_to_reference is None


def test_advantages_are_centred_and_scaled_by_the_group():
    values = group_advantages(torch.tensor([[0.0, 1.0, 2.0, 3.0]]), eps=0.0).values[0]
    sigma = math.sqrt(5 / 3)
    assert values.tolist() == pytest.approx([-1.5 / sigma, -0.5 / sigma, 0.5 / sigma, 1.5 / sigma])


@given(GROUPS)
def test_advantages_sum_to_zero_and_lost_rollouts_get_none(rows):
    rewards = torch.tensor(rows, dtype=torch.float64)
    result = group_advantages(rewards)
    assert torch.isfinite(result.values).all()
    assert result.values.sum(dim=1).abs().max().item() < 1e-6
    assert (result.values[torch.isnan(rewards)] == 0).all()


@given(st.lists(st.floats(-1, 32), min_size=2, max_size=7), st.integers(0, 6))
def test_lost_rollout_does_not_change_the_other_advantages(rewards, place):
    place = min(place, len(rewards))
    alone = group_advantages(torch.tensor([rewards], dtype=torch.float64)).values[0].tolist()
    padded = [*rewards[:place], LOST, *rewards[place:]]
    among = group_advantages(torch.tensor([padded], dtype=torch.float64)).values[0].tolist()
    assert [*among[:place], *among[place + 1 :]] == pytest.approx(alone, abs=1e-9)


@pytest.mark.parametrize("rewards", [[31.5] * 4, [LOST] * 4, [LOST, LOST, 0.5, LOST]])
def test_groups_with_equal_or_too_few_rewards_are_zero_variance(rewards):
    result = group_advantages(torch.tensor([rewards]))
    assert result.zero_variance.tolist() == [True]
    assert result.values.abs().max() == 0
