"""Typed result of a conversation: an instruction and the atoms that must hold, about existing objects."""

from __future__ import annotations

from enum import StrEnum
from typing import TYPE_CHECKING, Final

from pydantic import BaseModel, ConfigDict, Field

from embomatrix.factory.writer.goals import GoalConjunct
from embomatrix.world.goal import Atom, Formula, Not
from embomatrix.world.state import Relation

if TYPE_CHECKING:
    from embomatrix.factory.scenes.view import SceneView


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


class RequestedAtom(BaseModel):
    """Requested atom. ``place`` is the host of a relation. ``holds`` is false for closed or switched off."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    predicate: RequestPredicate
    thing: str
    place: str = ""
    holds: bool = True


class TaskRequest(BaseModel):
    """Instruction with its wishes."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    instruction: str = Field(min_length=10, max_length=400)
    wishes: tuple[RequestedAtom, ...] = Field(min_length=1, max_length=6)


def check_request(request: TaskRequest, view: SceneView, known: frozenset[str]) -> None:
    """Raise ValueError with a sentence for the model if a wish is not feasible in the scene."""
    for number, wish in enumerate(request.wishes, start=1):
        problem = _problem(wish, view, known)
        if problem:
            raise ValueError(f"wish {number}, {wish.predicate.value}: {problem}")
    if len(set(request.wishes)) < len(request.wishes):
        raise ValueError("two wishes are equal: leave one out")


def _problem(wish: RequestedAtom, view: SceneView, known: frozenset[str]) -> str:
    for name in (wish.thing, *([wish.place] if wish.place else [])):
        if name not in known:
            return f"there is no {name!r}: use a name from the list, such as {min(known)!r}"
    if wish.predicate in PLACED:
        return _placing_problem(wish, view)
    if wish.place:
        return f"it takes no place, found {wish.place!r}"
    if wish.predicate in THERMAL:
        if not wish.holds:
            return "cooked, hot and frozen can only be requested, not the contrary"
        if not view.asset(wish.thing).can("cookable"):
            return f"{wish.thing} can't be cooked, heated or frozen"
        return "" if view.robot.can_pick_up(wish.thing) else _out_of_reach(wish.thing)
    if wish.predicate is RequestPredicate.OPEN:
        if not view.is_openable(wish.thing):
            return f"{wish.thing} has no door or drawer"
        done, works = view.is_open(wish.thing), view.robot.can_swing(wish.thing, shut=not wish.holds)
    else:
        if not view.is_toggleable(wish.thing):
            return f"{wish.thing} can't be switched"
        done, works = view.is_on(wish.thing), view.robot.can_switch(wish.thing, on=wish.holds)
    if done is wish.holds:
        return f"{wish.thing} is already in this state"
    return "" if works else _out_of_reach(wish.thing)


def _placing_problem(wish: RequestedAtom, view: SceneView) -> str:
    if not wish.holds:
        return "name the place where the object must be, not one where it must not be"
    if not wish.place:
        return "it takes a place"
    inside = wish.predicate is RequestPredicate.INSIDE
    hosts = (
        view.is_container(wish.place) or view.is_basket(wish.place) if inside else view.is_surface(wish.place)
    )
    if not view.is_portable(wish.thing):
        return f"{wish.thing} can't be carried"
    if not hosts or not view.takes(wish.place, wish.thing, inside=inside):
        return f"{wish.thing} does not fit {'into' if inside else 'onto'} {wish.place}"
    if view.item(wish.thing).host == wish.place:
        return f"{wish.thing} is there already"
    if not view.robot.can_place(wish.thing, Relation(wish.predicate.value), wish.place):
        return f"the robot tried and can't place {wish.thing} there: request another object or place"
    return ""


def _out_of_reach(name: str) -> str:
    return f"the robot tried and can't reach {name}: request something else"


def conjunct_of(wish: RequestedAtom, view: SceneView) -> GoalConjunct:
    """Return the wish as a conjunct of a goal. The request's instruction holds its words."""
    names = (wish.thing, wish.place) if wish.place else (wish.thing,)
    atom: Formula = Atom(wish.predicate.value, names)
    categories = ",".join(view.category(name) for name in names)
    kind = "place" if wish.predicate in PLACED else "thermal" if wish.predicate in THERMAL else "switch"
    sign = f"{'' if wish.holds else 'not '}{wish.predicate.value}({categories})"
    return GoalConjunct(atom if wish.holds else Not(atom), "", names, (sign,), kind, wish.thing)
