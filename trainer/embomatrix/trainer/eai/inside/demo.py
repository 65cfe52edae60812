"""One task of EAI's BEHAVIOR split for its judge, assembled from the package's files, and the exact check of its goal.

Unpublished facts are reconstructed by the same rules for all tasks: bounding boxes (three classes), unmentioned states
(false), cartons (open), and furniture (on its room's floor).
"""

import ast
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from embomatrix.trainer.eai.inside.stand_ins import BINARY, UNARY, make_object, state_class

PREDICATES: Final = {state.lower(): state for state in (*BINARY, *UNARY)} | {"toggled_on": "ToggledOn"}
"""iGibson's states by the names of BDDL's predicates."""
RELATIONS: Final = frozenset(state.lower() for state in BINARY)
STARTS_OPEN: Final = frozenset({"carton.n.02"})
"""The published human plans put objects into cartons without opening them. All other openable objects start closed."""
OFF_FLOOR: Final = ("top_cabinet", "sink", "window", "door", "microwave", "room_floor")
"""Name prefixes of fixed objects that do not stand on the floor."""
FURNITURE_M: Final = (1.0, 1.0, 1.0)
CONTAINER_M: Final = (0.4, 0.4, 0.3125)
SMALL_M: Final = (0.1, 0.1, 0.1)
"""Boxes of the three classes. The judge only compares volumes, to reject objects that are too big."""
_TOOLS: Final = {"slicer": "Slicer", "cleaningTool": "CleaningTool"}
_ARTICULATED: Final = ("igibson.objects.articulated_object", "URDFObject")
_FLOOR: Final = ("igibson.object_states.on_floor", "RoomFloor")
_WRAPPERS: Final = "igibson.objects.multi_object_wrappers"


class Package:
    """Files of the installed package, read once."""

    def __init__(self) -> None:
        import behavior_eval
        from bddl.object_taxonomy import ObjectTaxonomy

        root = Path(behavior_eval.root_path)
        self._evaluation = root / "evaluation"
        stats = json.loads((root / "data" / "demo_stats.json").read_text())
        self.stats: dict[str, dict[str, Any]] = {name: stats[name] for name in sorted(stats)}
        prompts = self.read("action_sequencing/resources/prompts/helm_prompts.json")
        self.prompts = {entry["identifier"]: str(entry["llm_prompt"]) for entry in prompts}
        self.states = self.read("goal_interpretation/resources/data/all_objects.json")
        self.first_truths: dict[str, Any] = self.read("subgoal_decomposition/resources/error_list_dict.json")
        """Goals of each task and their truths in the initial state of the real simulator, as far as they are published."""
        self.taxonomy = ObjectTaxonomy()

    def read(self, path: str) -> Any:
        return json.loads((self._evaluation / path).read_text())

    def human_plan(self, name: str) -> str:
        path = self._evaluation / "action_sequencing/resources/human_annotations" / f"{name}.json"
        return path.read_text()

    def problem(self, name: str) -> str:
        """The task as BDDL text."""
        path = self._evaluation / "transition_modeling/resources/pddl_behavior" / f"{name}.pddl"
        return path.read_text()

    def abilities(self, synset: str, name: str) -> set[str]:
        """Abilities of the synset and of the model's own category, from which iGibson derives them."""
        found = (
            dict(self.taxonomy.get_abilities(synset) or {}) if self.taxonomy.is_valid_class(synset) else {}
        )
        try:
            own = self.taxonomy.get_class_name_from_igibson_category(re.sub(r"_\d+$", "", name))
            found.update(self.taxonomy.get_abilities(own) or {} if own else {})
        except ValueError:
            pass
        return set(found)


def flat(value: Any) -> list[str]:
    """Tokens of a nested list."""
    return [token for entry in value for token in (flat(entry) if isinstance(entry, list) else [entry])]


def simulator_names(prompt: str) -> list[dict[str, Any]]:
    """Objects of a prompt in its order, which is the order of the BDDL instances."""
    block = prompt[prompt.index("Your task:") :].split("interactable objects:")[1].split("Please output")[0]
    return [ast.literal_eval(line) for line in block.strip().splitlines()]


class Demo:
    """Stand-in for iGibson's BehaviorTask. ``graph`` is the state to judge, set by the caller."""

    def __init__(self, package: Package, name: str) -> None:
        from bddl.activity import Conditions, get_goal_conditions, get_initial_conditions, get_object_scope

        self.name = name
        self._package = package
        stats = package.stats[name]
        self._conditions = Conditions(stats["task"], stats["task_id"], simulator_name="igibson")
        scope = get_object_scope(self._conditions)
        self.instances = [instance for instance in scope if not instance.startswith("agent.")]
        self.synset = {
            instance: synset
            for synset, instances in self._conditions.parsed_objects.items()
            for instance in instances
        }
        self._init = self._conditions.parsed_initial_conditions
        self.room = {fact[1]: fact[2] for fact in self._init if fact[0] == "inroom"}
        self.objects: dict[str, Any] = {}
        """The object that each instance is, whole where it can be sliced."""
        self.object_scope: dict[str, Any] = {
            instance: object() for instance in scope if instance.startswith("agent.")
        }
        self._make_objects()
        self._set_first_state()
        self.initial_conditions = get_initial_conditions(self._conditions, backend(), self.object_scope)
        self.goal_conditions = get_goal_conditions(self._conditions, backend(), self.object_scope)
        self.graph: Any = None

    def check_success(self) -> tuple[bool, dict[str, list[int]]]:
        """Published check of the graph, in the format in which the judge queries the simulator."""
        result = self.graph.check_success(self)
        truths = result["subgoal_success"]
        return result["success"], {
            "satisfied": [at for at, true in enumerate(truths) if true],
            "unsatisfied": [at for at, true in enumerate(truths) if not true],
        }

    def _make_objects(self) -> None:
        names = simulator_names(self._package.prompts[self.name])
        containers = self._containers()
        for instance, entry in zip(self.instances, names, strict=True):
            if entry["category"] != self.synset[instance]:
                raise ValueError(f"{self.name}: found {entry}, expected {instance}")
            name, unary = entry["name"], self._states_of(instance, entry["name"])
            box = list(self._box(instance, containers))
            if name.startswith("room_floor"):
                item = self.object_scope[instance] = make_object(*_FLOOR, name, box, unary)
            else:
                item = make_object(*_ARTICULATED, name, box, unary)
                self.object_scope[instance] = (
                    self._sliceable(item, name, box, unary) if "Sliced" in unary else item
                )
            self.objects[instance] = item

    def _sliceable(self, whole: Any, name: str, box: list[float], unary: set[str]) -> Any:
        """Stand-in for iGibson's switch between an object and its two halves."""
        import sys

        module = sys.modules[_WRAPPERS]
        halves = module.ObjectGrouper()
        halves.objects = [
            make_object(*_ARTICULATED, f"{name}_part_{half}", box, unary - {"Sliced"}) for half in (0, 1)
        ]
        switch = module.ObjectMultiplexer()
        switch.name, switch._multiplexed_objects = f"{name}_multiplexer", [whole, halves]
        return switch

    def _states_of(self, instance: str, name: str) -> set[str]:
        found = set(self._package.states[self.name].get(instance, ()))
        abilities = self._package.abilities(self.synset[instance], name)
        found |= {state for ability, state in _TOOLS.items() if ability in abilities}
        for fact in self._init:
            tokens = flat(fact)
            if tokens[-1] == instance and len(tokens) == (3 if fact[0] == "not" else 2):
                found.add(PREDICATES[tokens[-2]])
        return found & {*BINARY, *UNARY}

    def _containers(self) -> set[str]:
        """Synsets of objects that contain another one, initially or in the goal."""
        found = set()
        for condition in (*self._init, *self._conditions.parsed_goal_conditions):
            tokens = flat(condition)
            for at, token in enumerate(tokens):
                if token == "inside":
                    place = tokens[at + 2].strip("?")
                    found.add(self.synset.get(place, place))
        return found

    def _box(self, instance: str, containers: set[str]) -> tuple[float, float, float]:
        if instance in self.room:
            return FURNITURE_M
        return CONTAINER_M if self.synset[instance] in containers else SMALL_M

    def _set_first_state(self) -> None:
        for instance, item in self.objects.items():
            opens = state_class("Open")
            if self.synset[instance] in STARTS_OPEN and opens in item.states:
                item.states[opens].holds = True
        for fact in self._init:
            holds = fact[0] != "not"
            predicate, *args = fact if holds else fact[1]
            if predicate != "inroom" and not any(arg.startswith("agent.") for arg in args):
                self._set(predicate, args, holds=holds)
        self._stand_on_floors()
        # Facts that the real simulator found true initially, although the task does not state them.
        truths = self._package.first_truths.get(self.name, {"subgoals": (), "subgoal_success": ()})
        for tokens, true in zip(truths["subgoals"], truths["subgoal_success"], strict=False):
            known = len(tokens) == 3 and tokens[0] in RELATIONS and set(tokens[1:]) <= self.objects.keys()
            if true and known:
                self._set(tokens[0], tokens[1:], holds=True)

    def _set(self, predicate: str, args: list[str], *, holds: bool) -> None:
        state = self.objects[args[0]].states[state_class(PREDICATES[predicate])]
        if predicate in RELATIONS:
            state.related.add(self.objects[args[1]].name)
        else:
            state.holds = holds

    def _stand_on_floors(self) -> None:
        on_floor = state_class("OnFloor")
        floors = {
            room: self.objects[instance].name
            for instance, room in self.room.items()
            if self.objects[instance].name.startswith("room_floor")
        }
        for instance, room in self.room.items():
            item = self.objects[instance]
            if room in floors and not item.name.startswith(OFF_FLOOR):
                item.states[on_floor].related.add(floors[room])
        for instance in self.instances:
            item = self.objects[instance]
            if item.name.startswith("room_floor"):
                # The published graph crashes on a scene without any edge. No goal mentions this one.
                item.states[on_floor].related.add(item.name)


_truths: list[Callable[..., bool]] = []
"""Truth function of the formulas under evaluation, as bddl passes no argument to its atoms."""


def backend() -> Any:
    """bddl backend whose atoms query ``_truths``."""
    from bddl.backend_abc import BDDLBackend
    from bddl.logic_base import BinaryAtomicFormula, UnaryAtomicFormula

    def binary(self: Any) -> bool:
        return _truths[-1](self.STATE_NAME, self.input1, self.input2)

    def unary(self: Any) -> bool:
        return _truths[-1](self.STATE_NAME, self.input)

    def refuse(self: Any, *args: Any) -> bool:
        """Raise RuntimeError: the graph of a demonstration has no scene in which an atom could be tested or sampled.

        bddl requires ``_evaluate`` and ``_sample`` of every atom. The first is only called by the ``evaluate`` that the
        functions above replace, the second only to make scenes.
        """
        raise RuntimeError(f"{self.STATE_NAME} is judged from the graph of a demonstration, not sampled")

    class Backend(BDDLBackend):
        def get_predicate_class(self, predicate_name: str) -> type:
            base, evaluate = (
                (BinaryAtomicFormula, binary) if predicate_name in RELATIONS else (UnaryAtomicFormula, unary)
            )
            body = {
                "STATE_NAME": predicate_name,
                "evaluate": evaluate,
                "_evaluate": refuse,
                "_sample": refuse,
            }
            return type(predicate_name, (base,), body)

    return Backend()


def exact_truths(demo: Demo) -> list[bool]:
    """Truth of each goal conjunct in ``demo.graph``. Containment is transitive, as in the simulator.

    The published check compares with a truncated list instead.
    """
    state = demo.graph.get_state_dict(demo)
    name = {instance: item.name for instance, item in demo.objects.items()}
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
    item: str, container: str, above: dict[str, str], relations: set[tuple[str, str, str]]
) -> bool:
    seen: set[str] = set()
    entered = False
    while item in above and item not in seen:
        seen.add(item)
        entered = entered or ("inside", item, above[item]) in relations
        item = above[item]
        if item == container:
            return entered
    return False
