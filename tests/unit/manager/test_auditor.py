"""Opinions, verdicts and reputations."""

from dataclasses import replace

from tests.fakes.worker import completed

from embomatrix.manager.control.reputation import Auditor, AuditRules, Reputation, judge, opinion_of
from embomatrix.manager.runtime.serialization import reputation_of, reputation_row
from embomatrix.reward.breakdown import AtomResult
from embomatrix.skills.turns import TurnObservation

SAME = {"platform": "a1", "pybullet": "3.2.7"}
OTHER = {"platform": "b2", "pybullet": "3.2.7"}


def opinion(worker_id="w1", versions=SAME, **changes):
    return opinion_of(worker_id, versions, replace(completed(worker_id), **changes))


def test_traces_are_compared_within_a_platform_and_facts_across_platforms():
    assert opinion().agrees(opinion("w2"))
    assert not opinion().agrees(opinion("w2", trace_digest="sha256:another"))
    assert opinion().agrees(opinion("w2", OTHER, trace_digest="sha256:another"))
    better = replace(completed().reward, atoms=(AtomResult("inside(cup, sink)", True),))
    assert not opinion().agrees(opinion("w2", OTHER, reward=better))
    richer = replace(completed().reward, goal=30.0)
    assert not opinion().agrees(opinion("w2", OTHER, reward=richer))


def test_observations_of_turns_are_compared_within_a_platform():
    seen = TurnObservation("kitchen_0", ("cup_1",), ("cup_1: in the robot's hand",), looked=True, sees=(1, 4))
    invented = replace(seen, sees=(1, 2, 4))
    honest = opinion(observation=seen)
    assert honest.agrees(opinion("w2", observation=seen))
    assert not honest.agrees(opinion("w2", observation=invented))
    assert not honest.agrees(opinion("w2", observation=replace(seen, room="bath_0")))
    assert honest.agrees(opinion("w2", OTHER, observation=invented))
    padded = replace(seen, changes=("x" * 4_000,) * 3)
    assert not honest.agrees(opinion("w2", OTHER, observation=padded))
    assert judge([honest, opinion("w2", observation=invented), opinion("w3", observation=seen)]) == (
        (0, 2),
        (1,),
    )


def test_workers_without_a_fingerprint_are_compared_by_facts():
    assert opinion(versions={}).agrees(opinion("w2", {}, trace_digest="sha256:another"))


def test_sentences_may_differ_but_not_be_padded():
    assert opinion(final=("the cup is in the sink",)).agrees(opinion("w2", final=()))
    padded = opinion("w2", final=("x" * 4_000,) * 3)
    assert not opinion().agrees(padded)
    assert judge([opinion(), padded, opinion("w3")]) == ((0, 2), (1,))
    assert opinion(final=("y" * 4_000,)).agrees(padded)


def test_only_an_opinion_against_two_that_agree_is_wrong():
    first, second, third = opinion("w1"), opinion("w2"), opinion("w3", trace_digest="invented")
    assert judge([first]) is None
    assert judge([first, third]) is None
    assert judge([first, third, second]) == ((0, 2), (1,))
    assert judge([first, third, opinion("w2", trace_digest="too")]) is None
    # Another platform agrees with two results that differ only in their traces: neither is proved wrong.
    assert judge([first, third, opinion("w2", OTHER)]).wrong == ()


def test_changed_reputation_is_stored_without_open_disputes():
    auditor = Auditor(AuditRules(probation=2), b"key")
    auditor.took("w1")
    auditor.agreed("w1")
    auditor.of("w1").disputed += 1
    auditor.convict("w2", "it contradicts w1 and w3")
    written = [reputation_row(worker_id, auditor.of(worker_id)) for worker_id in auditor.take_changed()]
    assert auditor.take_changed() == []
    successor = Auditor(AuditRules(probation=2), b"key")
    successor.know({row.key: reputation_of(row) for row in written})
    assert successor.of("w1") == Reputation(taken=1, agreed=1, audited=1)
    assert successor.of("w2").quarantine == "it contradicts w1 and w3"
    assert successor.take_changed() == []


def test_share_after_probation_is_drawn_by_a_secret_key():
    rules = AuditRules(probation=2, share=0.1)
    drawn = {}
    for key in (b"one", b"two"):
        auditor = Auditor(rules, key)
        for _ in range(2):
            assert auditor.wants("w1", "lease", verified=True)
            auditor.agreed("w1")
        drawn[key] = {n for n in range(5000) if auditor.wants("w1", f"boot-{n}", verified=True)}
        assert 400 <= len(drawn[key]) <= 600
    assert len(drawn[b"one"] & drawn[b"two"]) < 100
