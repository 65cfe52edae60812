"""Whether a goal holds in the judge's graph, by the formula itself: the published check compares with a list cut short."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable

    from embomatrix.trainer.eai.inside.demo import Demo

    Truth = Callable[..., bool]

_truths: list[Truth] = []
"""What the formulas under evaluation are asked of; bddl gives its atoms no argument for that."""


def backend() -> Any:
    """Atoms for bddl that ask ``_truths``."""
    from bddl.backend_abc import BDDLBackend
    from bddl.logic_base import BinaryAtomicFormula, UnaryAtomicFormula

    from embomatrix.trainer.eai.inside.demo import RELATIONS

    def binary(self: Any) -> bool:
        return _truths[-1](self.STATE_NAME, self.input1, self.input2)

    def unary(self: Any) -> bool:
        return _truths[-1](self.STATE_NAME, self.input)

    def unasked(self: Any, *args: Any) -> bool:
        """bddl wants both methods of an atom. ``evaluate`` above never comes to the one, and a judge samples no state."""
        raise NotImplementedError(f"{self.STATE_NAME} is only judged here: no state is sampled")

    class Backend(BDDLBackend):  # type: ignore[misc]
        def get_predicate_class(self, predicate_name: str) -> type:
            base, evaluate = (
                (BinaryAtomicFormula, binary) if predicate_name in RELATIONS else (UnaryAtomicFormula, unary)
            )
            body = {
                "STATE_NAME": predicate_name,
                "evaluate": evaluate,
                "_evaluate": unasked,
                "_sample": unasked,
            }
            return type(predicate_name, (base,), body)

    return Backend()


def exact_truths(demo: Demo) -> list[bool]:
    """The truth of each conjunct of the goal in ``demo.graph``. An inside of an inside counts, as in the simulator."""
    state = demo.graph.get_state_dict(demo)
    name = {instance: thing.name for instance, thing in demo.things.items()}
    unary = {node: set(value["states"]) for node, value in state["nodes"].items()}
    relations = {(edge["relation"], edge["from_name"], edge["to_name"]) for edge in state["edges"]}
    above = {one: other for relation, one, other in relations if relation in ("inside", "ontop")}

    def truth(predicate: str, *instances: str) -> bool:
        names = [name[instance] for instance in instances]
        if len(names) == 1:
            return {"toggled_on": "toggledon"}.get(predicate, predicate) in unary.get(names[0], ())
        if (predicate, *names) in relations:
            return True
        return predicate == "inside" and _is_within(names[0], names[1], above, relations)

    _truths.append(truth)
    try:
        return [bool(goal.evaluate()) for goal in demo.goal_conditions]
    finally:
        _truths.pop()


def _is_within(
    thing: str, container: str, above: dict[str, str], relations: set[tuple[str, str, str]]
) -> bool:
    seen: set[str] = set()
    entered = False
    while thing in above and thing not in seen:
        seen.add(thing)
        entered = entered or ("inside", thing, above[thing]) in relations
        thing = above[thing]
        if thing == container:
            return entered
    return False
