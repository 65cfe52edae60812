"""Checks of a problem before any scene is considered: known types, representable state, and goals within the skills' reach."""

import difflib
from typing import Final

from embomatrix.factory.admission import RefusalReason, RefusedError
from embomatrix.factory.task_import.reach import FUTURE, HELD, INSOURCE, Reachability, pieces_of
from embomatrix.world.bddl import BddlProblem, is_room_instance
from embomatrix.world.catalog import Catalog
from embomatrix.world.evaluate import atoms_of, render
from embomatrix.world.goal import Atom
from embomatrix.world.state import Relation
from embomatrix.world.substances import is_substance

FLOORS: Final = frozenset({"floor.n.01", "driveway.n.01", "lawn.n.01"})
"""Types of floors. A garden is one plane here; lawn and driveway are its floor."""
AGENT: Final = "agent.n.01"


def check_expressible(problem: BddlProblem, *, reachable: bool = True) -> None:
    """Raise RefusedError if no scene can represent the problem or no skill can reach its goal.

    Without ``reachable``, the goal must only be evaluable.
    """
    _check_types(problem)
    if reachable:
        _check_reach(problem)
    for atom in atoms_of(problem.goal):
        if not reachable and atom.predicate not in HELD:
            raise RefusedError(
                RefusalReason.INEXPRESSIBLE,
                f"the goal needs {render(atom)}, which scenes can't represent",
            )
        _check_goal_args(problem, atom)
    _check_start(problem)


def _check_types(problem: BddlProblem) -> None:
    catalog = Catalog.load()
    for name, type_name in problem.objects.items():
        if type_name == AGENT or type_name in FLOORS:
            continue
        if not catalog.has_synset(type_name):
            raise RefusedError(
                RefusalReason.UNKNOWN_TYPE,
                f"type {type_name!r} of {name!r} is in no catalog{_close_synsets(type_name)}",
            )
        if not is_substance(type_name) and not catalog.categories_of(type_name):
            raise RefusedError(RefusalReason.UNKNOWN_TYPE, f"no category has a model of type {type_name!r}")


def _close_synsets(type_name: str) -> str:
    catalog = Catalog.load()
    synsets = sorted({catalog.synset_of(category) for category in catalog.category_names})
    close = difflib.get_close_matches(type_name, synsets, n=3, cutoff=0.6)
    return f": did you mean {', '.join(close)}?" if close else ""


def _check_reach(problem: BddlProblem) -> None:
    unreachable_part = Reachability(problem).unreachable_part(problem.goal)
    if unreachable_part is not None:
        solid = not any(
            is_substance(_type(problem, arg)) for atom in atoms_of(unreachable_part) for arg in atom.args[:1]
        )
        raise RefusedError(
            RefusalReason.INEXPRESSIBLE if solid else RefusalReason.SUBSTANCE,
            f"the goal needs {render(unreachable_part)}, which no skill achieves",
        )


def _check_start(problem: BddlProblem) -> None:
    pieces = {half for halves in pieces_of(problem).values() for half in halves}
    for item in problem.init:
        predicate, args = item.atom.predicate, item.atom.args
        if item.positive and predicate not in HELD | {INSOURCE}:
            raise RefusedError(
                RefusalReason.INEXPRESSIBLE,
                f"the start needs {predicate!r}, which scenes can't represent",
            )
        if predicate in set(Relation) and any(is_substance(_type(problem, arg)) for arg in args):
            raise RefusedError(
                RefusalReason.SUBSTANCE, f"the start needs {render(item.atom)}: a substance has no place"
            )
        if predicate == FUTURE and args[0] not in pieces and not is_substance(_type(problem, args[0])):
            raise RefusedError(
                RefusalReason.INEXPRESSIBLE,
                f"{args[0]!r} is a future object that no skill makes: only halves are made",
            )
        for arg in args[: 1 if predicate == Relation.INROOM else 2]:
            _check_no_room(problem, arg)


def _type(problem: BddlProblem, arg: str) -> str:
    """Return the type of an object, or of a bound variable named after its type, such as ``?water.n.06``."""
    return problem.objects.get(arg, arg.lstrip("?"))


def _check_goal_args(problem: BddlProblem, atom: Atom) -> None:
    objects = atom.args[:1] if atom.predicate == Relation.INROOM else atom.args
    for arg in objects:
        if arg.startswith("?"):
            continue
        _check_no_room(problem, arg)
        if problem.objects[arg] == AGENT:
            raise RefusedError(RefusalReason.AGENT_IN_GOAL, "the goal is about the robot's own position")


def _check_no_room(problem: BddlProblem, arg: str) -> None:
    if arg not in problem.objects and is_room_instance(arg):
        raise RefusedError(RefusalReason.ROOM_AS_OBJECT, f"{arg!r} is a room: expected an object")
