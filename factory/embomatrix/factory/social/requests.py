"""Typed result of a conversation: an instruction and the atoms that must hold, about existing objects."""

from enum import StrEnum
from typing import Final

from pydantic import Field

from embomatrix.factory.scenes.view import SceneView
from embomatrix.factory.social.values import StrictModel
from embomatrix.factory.writer.goals import GoalConjunct
from embomatrix.world.goal import Atom, Formula, Not
from embomatrix.world.intent import IntentClause
from embomatrix.world.state import Relation, State


class RequestPredicate(StrEnum):
    """Predicates that a request may use. The robot's skills can achieve all of them."""

    ONTOP = "ontop"
    INSIDE = "inside"
    OPEN = "open"
    TOGGLED_ON = "toggled_on"
    COOKED = "cooked"
    HOT = "hot"
    FROZEN = "frozen"


PLACED: Final = frozenset({RequestPredicate.ONTOP, RequestPredicate.INSIDE})
THERMAL: Final = frozenset({RequestPredicate.COOKED, RequestPredicate.HOT, RequestPredicate.FROZEN})


class RequestedAtom(StrictModel):
    """Requested atom. ``place`` is the host of a relation, or the source of a thermal state if the instruction names one.

    ``holds`` is false for closed or switched off.
    """

    predicate: RequestPredicate
    thing: str
    place: str = ""
    holds: bool = True


class TaskRequest(StrictModel):
    """Instruction with its requested atoms."""

    instruction: str = Field(min_length=10, max_length=400)
    wishes: tuple[RequestedAtom, ...] = Field(min_length=1, max_length=6)


def check_request(request: TaskRequest, view: SceneView, known: frozenset[str]) -> None:
    """Raise ValueError with a sentence for the model if a requested atom is infeasible in the scene."""
    for number, requested in enumerate(request.wishes, start=1):
        problem = _problem(requested, view, known)
        if problem:
            raise ValueError(f"wish {number}, {requested.predicate.value}: {problem}")
    if len(set(request.wishes)) < len(request.wishes):
        raise ValueError("two wishes are equal: leave one out")


def _problem(requested: RequestedAtom, view: SceneView, known: frozenset[str]) -> str:
    for name in (requested.thing, *([requested.place] if requested.place else [])):
        if name not in known:
            return f"there is no {name!r}: use a name from the list, such as {min(known)!r}"
    if requested.predicate in PLACED:
        return _placing_problem(requested, view)
    if requested.predicate in THERMAL:
        return _thermal_problem(requested, view)
    if requested.place:
        return f"it takes no place, found {requested.place!r}"
    if requested.predicate is RequestPredicate.OPEN:
        if not view.is_openable(requested.thing):
            return f"{requested.thing} has no door or drawer"
        done, works = (
            view.is_open(requested.thing),
            view.robot.can_swing(requested.thing, shut=not requested.holds),
        )
    else:
        if not view.is_toggleable(requested.thing):
            return f"{requested.thing} can't be switched"
        done, works = view.is_on(requested.thing), view.robot.can_switch(requested.thing, on=requested.holds)
    if done is requested.holds:
        return f"{requested.thing} is already in this state"
    return "" if works else _out_of_reach(requested.thing)


def _placing_problem(requested: RequestedAtom, view: SceneView) -> str:
    if not requested.holds:
        return "name the place where the object must be, not one where it must not be"
    if not requested.place:
        return "it takes a place"
    inside = requested.predicate is RequestPredicate.INSIDE
    hosts = (
        view.is_container(requested.place) or view.is_basket(requested.place)
        if inside
        else view.is_surface(requested.place)
    )
    if not view.is_portable(requested.thing):
        return f"{requested.thing} can't be carried"
    if not hosts or not view.takes(requested.place, requested.thing, inside=inside):
        return f"{requested.thing} does not fit {'into' if inside else 'onto'} {requested.place}"
    if view.item(requested.thing).host == requested.place:
        return f"{requested.thing} is there already"
    if not view.robot.can_place(requested.thing, Relation(requested.predicate.value), requested.place):
        return f"the robot tried and can't place {requested.thing} there: request another object or place"
    return ""


def _thermal_problem(requested: RequestedAtom, view: SceneView) -> str:
    thing, source = requested.thing, requested.place
    if not requested.holds:
        return "cooked, hot and frozen can only be requested, not the contrary"
    if not view.asset(thing).can("cookable"):
        return f"{thing} can't be cooked, heated or frozen"
    state = State(requested.predicate.value)
    if source and not (view.is_source(source) and state in view.thermal_effects(thing, source)):
        return f"{source} does not make {thing} {state.value}: name another place, or none"
    if source and not view.robot.can_treat(thing, source, state):
        return f"the robot tried and can't use {source} for {thing}: request another place, or none"
    return "" if view.robot.can_pick_up(thing) else _out_of_reach(thing)


def _out_of_reach(name: str) -> str:
    return f"the robot tried and can't reach {name}: request something else"


def conjunct_of(requested: RequestedAtom, view: SceneView) -> GoalConjunct:
    """Return the atom as a conjunct of a goal. Its words are in the request's instruction."""
    names = (requested.thing, requested.place) if requested.place else (requested.thing,)
    atom: Formula = Atom(requested.predicate.value, names)
    categories = ",".join(view.category(name) for name in names)
    kind = (
        "place"
        if requested.predicate in PLACED
        else "thermal"
        if requested.predicate in THERMAL
        else "switch"
    )
    sign = f"{'' if requested.holds else 'not '}{requested.predicate.value}({categories})"
    return GoalConjunct(
        atom if requested.holds else Not(atom),
        "",
        names,
        (sign,),
        kind,
        requested.thing,
        intent=(IntentClause(requested.predicate.value, names[:1], names[1:], requested.holds),),
    )
