"""Likeness of goals: shared conditions, whatever the names of problems, objects and rooms."""

from embomatrix.factory.task_import.likeness import conditions_of, likeness
from embomatrix.world.bddl import parse_problem


def goal(objects: str, formula: str) -> frozenset[tuple[bool, str, tuple[str, ...]]]:
    text = f"(define (problem p) (:domain d) (:objects {objects}) (:init) (:goal {formula}))"
    return conditions_of(parse_problem(text))


MUGS = goal(
    "mug.n.04_1 mug.n.04_2 - mug.n.04 coffee_table.n.01_1 - coffee_table.n.01",
    "(and (ontop ?mug.n.04_1 ?coffee_table.n.01_1) (ontop ?mug.n.04_2 ?coffee_table.n.01_1))",
)


def test_numbers_of_objects_and_quantifiers_do_not_count() -> None:
    every = goal(
        "mug.n.04_1 - mug.n.04 breakfast_table.n.01_1 - breakfast_table.n.01",
        "(forall (?m - mug.n.04) (ontop ?m ?breakfast_table.n.01_1))",
    )
    assert every == MUGS
    assert likeness(every, MUGS) == 1.0


def test_dusty_is_a_fact_about_dust_and_polarity_counts() -> None:
    objects = "floor.n.01_1 - floor.n.01"
    dusty, clean = (goal(objects, text) for text in ("(dusty ?floor.n.01_1)", "(not (dusty ?floor.n.01_1))"))
    dust = goal(f"{objects} dust.n.01_1 - dust.n.01", "(not (covered ?floor.n.01_1 ?dust.n.01_1))")
    assert clean == dust == {(False, "covered", ("floor", "dust"))}
    assert likeness(dusty, clean) == 0.0


def test_likeness_is_the_share_of_conditions_in_both() -> None:
    more = MUGS | goal("fridge.n.01_1 - fridge.n.01", "(open ?fridge.n.01_1)")
    assert likeness(MUGS, more) == likeness(more, MUGS) == 0.5
