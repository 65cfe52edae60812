"""BDDL of other simulators, for tests of the import."""

from typing import Final

from embomatrix.factory.task_import.sources import (
    SourceText,
)

PROBLEM: Final = """(define (problem Put_the_apples_in_the_fridge_in_kitchen_0)
    (:domain omnigibson)
    (:objects
        apple.n.01_1 apple.n.01_2 - apple.n.01
        electric_refrigerator.n.01_1 - electric_refrigerator.n.01
        breakfast_table.n.01_1 - breakfast_table.n.01
        floor.n.01_1 - floor.n.01
        agent.n.01_1 - agent.n.01
    )
    (:init
        (ontop apple.n.01_1 breakfast_table.n.01_1)
        (ontop apple.n.01_2 breakfast_table.n.01_1)
        (inroom electric_refrigerator.n.01_1 kitchen)
        (inroom breakfast_table.n.01_1 kitchen)
        (open electric_refrigerator.n.01_1)
        (inroom floor.n.01_1 kitchen)
        (ontop agent.n.01_1 floor.n.01_1)
    )
    (:goal
        (and
            (forall (?apple.n.01 - apple.n.01) (inside ?apple.n.01 ?electric_refrigerator.n.01_1))
            (not (open ?electric_refrigerator.n.01_1))
        )
    )
)
"""
"""Two apples into the fridge of a kitchen, and its door shut: five objects, a quantifier and a negation."""


def source(text: str = PROBLEM) -> SourceText:
    """Return the problem as read from a file named ``apples``."""
    return SourceText("apples", text, "file")
