"""BDDL text of complete problems."""

from __future__ import annotations

from typing import TYPE_CHECKING

from embomatrix.world.evaluate import render
from embomatrix.world.goal import Not

if TYPE_CHECKING:
    from embomatrix.world.bddl import BddlProblem


def render_problem(problem: BddlProblem) -> str:
    """Render BDDL text that ``parse_problem`` parses to an equal problem."""
    grouped: dict[str, list[str]] = {}
    for name, type_name in problem.objects.items():
        grouped.setdefault(type_name, []).append(name)
    objects = "\n".join(f"        {' '.join(names)} - {type_name}" for type_name, names in grouped.items())
    init = "\n".join(
        f"        {render(item.atom if item.positive else Not(item.atom))}" for item in problem.init
    )
    return (
        f"(define (problem {problem.name})\n    (:domain omnigibson)\n    (:objects\n{objects}\n    )\n"
        f"    (:init\n{init}\n    )\n    (:goal\n        {render(problem.goal)}\n    )\n)\n"
    )
