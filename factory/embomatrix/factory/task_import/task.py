"""Import of one BDDL problem: a task in its own scene, or a refusal with a reason."""

import dataclasses
import hashlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np

from embomatrix.factory.admission import RefusalReason, RefusedError, TaskRefusal
from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.furnish.roles import is_portable
from embomatrix.factory.layout.generator import lay
from embomatrix.factory.layout.request import Layout, RequestedObject
from embomatrix.factory.layout.values import LayoutFailure, LayoutRelation
from embomatrix.factory.scenes.editor import SceneEditor, add_floor
from embomatrix.factory.scenes.view import SceneView, is_liftable
from embomatrix.factory.task_import.binding import Addition, Binding, bind
from embomatrix.factory.task_import.dialects import read_problem
from embomatrix.factory.task_import.expressible import AGENT, FLOORS
from embomatrix.factory.task_import.missing_sources import with_missing_sources
from embomatrix.factory.task_import.models import models_for, with_sizes
from embomatrix.factory.task_import.neighbours import neighbours_of
from embomatrix.factory.task_import.reach import FUTURE, INSOURCE, pieces_of, profile_for
from embomatrix.factory.task_import.scene_changes import SceneChange, changes_of
from embomatrix.factory.task_import.search import BindingOptions
from embomatrix.factory.task_import.size_requirements import requirement_on, requirements_of
from embomatrix.factory.task_import.sources import SourceText
from embomatrix.factory.task_import.start_state import with_robot_in, with_states
from embomatrix.factory.task_import.task_fields import (
    instruction_of,
    signature_of,
    sources_for,
    taps_for,
)
from embomatrix.factory.writer.categories import REAL, SWITCHED, category_of
from embomatrix.factory.writer.tasks import object_table
from embomatrix.world.asset import Asset
from embomatrix.world.bddl import BddlProblem, InitLiteral, is_room_instance
from embomatrix.world.catalog import Catalog, Model, share_of
from embomatrix.world.evaluate import atoms_of, objects_of, render, substitute, types_of
from embomatrix.world.goal import Atom
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation, SubstanceRelation
from embomatrix.world.substances import flows_from, is_substance
from embomatrix.world.task import MAX_TABLE, Task


class Lay(Protocol):
    """Layout method: ``layout.generator.lay`` or a baseline."""

    def __call__(self, editor: SceneEditor, items: Sequence[RequestedObject], seed: int) -> Layout: ...


MAX_EXCLUDED: Final = 3
"""Maximum number of furniture pieces excluded because they can't hold what the problem puts there."""
MAX_REDRAWN: Final = 3
"""Maximum number of further layouts drawn if the robot can't reach all objects."""


@dataclass(frozen=True, slots=True)
class ImportedTask:
    """Task bound to a scene. ``init`` must hold at the start; it is not verified yet."""

    scene: Scene
    task: Task
    init: tuple[InitLiteral, ...]
    about: tuple[str, ...]
    """Scene names of the problem's objects."""
    rooms: tuple[str, ...]
    signature: str
    instances: tuple[str, ...] = ()
    """The problem's own names of the same objects."""
    notes: tuple[str, ...] = ()
    """Changes made to the problem, and furniture added to the scene."""
    changes: tuple[SceneChange, ...] = ()
    """Changes that make the binding unfaithful, one for each piece, object or room."""
    is_held_out: bool = False
    """True if the task is used for evaluation only."""


@dataclass(frozen=True, slots=True)
class ImportOptions(BindingOptions):
    """Options of an import: those of the binding, and the layout method."""

    lay: Lay = lay
    compact: bool = False
    """If true, objects that share a host are scaled to fit side by side, and hosts have room for what the goal puts there."""


def import_problem(
    source: SourceText, base: Scene, *, seed: int = 0, options: ImportOptions | None = None
) -> ImportedTask | TaskRefusal:
    """Bind a problem to a base scene and add missing objects. Raise BddlError for invalid text."""
    problem, notes = read_problem(source)
    digest = hashlib.sha256(f"{seed} {base.scene_id} {source.text}".encode()).digest()
    rng = np.random.default_rng(np.random.SeedSequence(list(digest[:8])))
    try:
        imported = _Binder(
            source, problem, base, rng, digest.hex()[:6], options or ImportOptions()
        ).imported()
        return dataclasses.replace(imported, notes=(*notes, *imported.notes), is_held_out=source.is_held_out)
    except RefusedError as error:
        return error.refusal


class _Binder:
    """One import. ``names`` maps the problem's objects to scene objects."""

    def __init__(
        self,
        source: SourceText,
        problem: BddlProblem,
        base: Scene,
        rng: np.random.Generator,
        key: str,
        options: ImportOptions,
    ) -> None:
        self._source = source
        self._problem = with_missing_sources(problem, base) if options.reachable else problem
        self._substances = {name: synset for name, synset in problem.objects.items() if is_substance(synset)}
        self._base = base
        self._rng = rng
        self._options = options
        self._scene_id = f"{base.base}-{slug_of(source.name)}-{key}"
        self._requirements = requirements_of(problem)

    def imported(self) -> ImportedTask:
        binding, editor, names = self._bound()
        self._problem = binding.problem
        for whole, halves in pieces_of(self._problem).items():
            names |= zip(halves, self._add_pieces(editor, names[whole], halves), strict=True)
        for name in self._portable_fixtures(editor, names):
            editor.loosen(name)
        if self._options.usable:
            for host in self._goal_hosts():
                if names.get(host) in editor.objects:
                    editor.clear(names[host])
        for floor in self._floor_objects(editor, names, binding):
            names[floor] = self._add_floor(editor, floor, binding)
        start = self._start(names, binding)
        scene = with_states(with_robot_in(editor.freeze(self._scene_id), binding.robot_room), start)
        return self._task(scene, names, binding, start)

    def _goal_hosts(self) -> Iterator[str]:
        """Yield the problem's objects on or in which the goal may put something."""
        for atom in atoms_of(self._problem.goal):
            if atom.predicate in (Relation.ONTOP, Relation.INSIDE):
                host = atom.args[1].lstrip("?")
                yield from self._problem.types.get(host, (host,))

    def _bound(self) -> tuple[Binding, SceneEditor, dict[str, str]]:
        """Bind the problem and lay it out. Furniture that can't hold the problem's objects is excluded in further attempts.

        Furniture whose contents the robot can't reach is excluded too, while other furniture is left. After that, the
        layout is redrawn, and the layout with the fewest unreachable objects is used.
        """
        excluded, redrawn = set[str](), 0
        first: RefusedError | None = None
        fallback: tuple[Binding, SceneEditor, dict[str, str]] | None = None
        fewest = math.inf
        while True:
            try:
                binding = bind(self._problem, self._base, self._rng, self._options, excluded)
            except RefusedError as error:
                if fallback is not None:
                    return fallback
                raise first or error from error
            editor = SceneEditor(self._base)
            layout = self._lay(editor, binding)
            if not layout.failures:
                bound = binding, editor, {**binding.found, **layout.names}
                if not layout.unreachable:
                    return bound
                if len(layout.unreachable) < fewest:
                    fewest, fallback = len(layout.unreachable), bound
            wrong = (*layout.failures, *layout.unreachable)[0]
            first = first or _misfit(wrong)
            if wrong.host in binding.found.values() and len(excluded) < MAX_EXCLUDED:
                excluded.add(wrong.host)
            elif not layout.failures and redrawn < MAX_REDRAWN:
                redrawn += 1
            elif fallback is not None:
                return fallback
            else:
                raise first

    def _add_floor(self, editor: SceneEditor, floor: str, binding: Binding) -> str:
        if floor not in binding.floors:
            raise RefusedError(
                RefusalReason.NO_PLACE_GIVEN, f"the start gives no room for the floor {floor!r}"
            )
        return add_floor(editor, binding.floors[floor])

    def _floor_objects(
        self, editor: SceneEditor, names: Mapping[str, str], binding: Binding
    ) -> tuple[str, ...]:
        """Return the floors that become objects: those in the goal, and those with an object that gets a neighbour."""
        about = {arg for atom in atoms_of(self._problem.goal) for arg in atom.args} | types_of(
            self._problem.goal
        )
        pairs = neighbours_of(
            self._problem.goal,
            self._problem.types,
            lambda name: self._is_portable(editor, names.get(name, "")),
        )
        standing = [
            editor.known(names[pair.neighbour]) for pair in pairs if pair.neighbour in names and not pair.host
        ]
        beside = {item.room for item in standing if not item.host}
        return tuple(
            name
            for name, type_name in self._problem.objects.items()
            if type_name in FLOORS and ({name, type_name} & about or binding.floors.get(name) in beside)
        )

    def _is_portable(self, editor: SceneEditor, name: str) -> bool:
        if name not in editor.objects or editor.known(name).fixed:
            return False
        asset = editor.asset_of(name)
        return is_liftable(asset.size_m, asset.mass_kg)

    def _portable_fixtures(self, editor: SceneEditor, names: Mapping[str, str]) -> Iterator[str]:
        """Yield portable appliances, such as a kettle, that the scene treats as fixed but this problem wants carried."""
        for name, type_name in self._problem.objects.items():
            if requirement_on(self._requirements, name, type_name).carried and name in names:
                asset = editor.asset_of(names[name])
                if is_liftable(asset.size_m, asset.mass_kg) and not is_portable(asset):
                    yield names[name]

    def _lay(self, editor: SceneEditor, binding: Binding) -> Layout:
        """Add all missing objects to the scene."""
        editor.keep(binding.found.values())
        models = self._models(binding, editor)
        items = [
            self._item(addition, binding, models[addition.name], editor.imported)
            for addition in binding.additions
        ]
        return self._options.lay(editor, items, int(self._rng.integers(2**31)))

    def _models(self, binding: Binding, editor: SceneEditor) -> Mapping[str, Sequence[Model]]:
        """Return the models to try for each addition, the best first. Some are scaled."""
        requirements = {
            name: requirement_on(self._requirements, name, type_name)
            for name, type_name in self._problem.objects.items()
        }
        orders = {
            each.name: models_for(
                each,
                self._rng,
                requirements[each.name],
                self._options.categories_of(binding.problem, each.name),
                editor.imported,
            )
            for each in binding.additions
        }
        for addition in binding.additions:
            if not orders[addition.name]:
                abilities = f" with the abilities that the task needs: {', '.join(sorted(addition.needs))}"
                raise RefusedError(
                    RefusalReason.DOES_NOT_FIT,
                    f"{addition.name!r} has no place: its type has no model{abilities if addition.needs else ''}",
                    addition.name,
                )
        found = {name: editor.asset_of(there) for name, there in binding.found.items()}
        return with_sizes(orders, binding.additions, requirements, found, compact=self._options.compact)

    def _item(
        self, addition: Addition, binding: Binding, models: Sequence[Model], imported: Mapping[str, Asset]
    ) -> RequestedObject:
        rooms = (addition.room,) if addition.room else tuple(dict.fromkeys(binding.rooms.values()))
        demanded = addition.relation is not None
        host = binding.found.get(addition.host, addition.host) or (addition.room if demanded else "")
        return RequestedObject(
            name=addition.name,
            models=tuple((model.category, model.model_id) for model in models),
            relation=LayoutRelation(addition.relation.value) if addition.relation else None,
            host=host,
            rooms=() if host or addition.beside else rooms,
            beside=tuple(binding.found.get(other, other) for other in addition.beside),
            imported=imported,
        )

    def _add_pieces(self, editor: SceneEditor, whole: str, halves: tuple[str, ...]) -> tuple[str, ...]:
        """Add the halves of an object, with the model whose volume is nearest to half of the whole."""
        catalog = Catalog.load()
        half_m3 = math.prod(editor.asset_of(whole).size_m) / 2
        models = [
            model
            for category in catalog.categories_of(self._problem.objects[halves[0]])
            for model in catalog.models_of(category)
        ]
        model = min(models, key=lambda model: abs(math.prod(model.size_m) - half_m3))
        asset = editor.imported.get(model.asset_id) or build_asset(catalog, model.category, model.model_id)
        return editor.add_pieces(whole, asset, len(halves))

    def _task(
        self, scene: Scene, names: dict[str, str], binding: Binding, start: tuple[InitLiteral, ...]
    ) -> ImportedTask:
        view = SceneView(scene)
        types = {
            type_name: tuple({**names, **self._substances}[name] for name in self._problem.types[type_name])
            for type_name in sorted(types_of(self._problem.goal))
        }
        goal = substitute(self._problem.goal, {**names, **self._substances, **binding.rooms})
        about = objects_of(goal, types)
        known = tuple(names.values())
        needed = dict.fromkeys((*known, *sources_for(view, goal, types, known), *taps_for(view, goal, known)))
        table = object_table(view, tuple(needed), self._rng)
        missing = about - set(table)
        if missing:
            raise RefusedError(
                RefusalReason.TABLE_TOO_LONG,
                f"the goal has {len(about)} objects: expected at most {MAX_TABLE}, the rows of a table",
            )
        task = Task(
            task_id=self._scene_id,
            scene_id=scene.scene_id,
            instruction=instruction_of(self._source, self._problem, binding.rooms),
            category=category_of(goal),
            goal=goal,
            goal_bddl=render(goal),
            table=table,
            types=types,
            source=self._source.source,
            profile=profile_for(goal),
        )
        rooms = tuple(sorted({view.room(name) for name in about}))
        notes = self._notes(view, names, binding)
        signature = signature_of(goal, view)
        return ImportedTask(
            scene,
            task,
            start,
            tuple(names.values()),
            rooms,
            signature,
            tuple(names),
            notes,
            changes_of(self._source, self._base, binding, names, scene),
        )

    def _notes(self, view: SceneView, names: Mapping[str, str], binding: Binding) -> tuple[str, ...]:
        """Return a sentence for each change to scene and problem."""
        added = tuple(
            f"{self._base.base} lacks {each.type}: {names[each.name]} was added to {view.room(names[each.name])}"
            for each in binding.additions
            if each.is_missing_furniture and view.item(names[each.name]).fixed
        )
        moved = tuple(
            f"{word} is read as {room}"
            for word, room in binding.rooms.items()
            if is_room_instance(word) and word != room
        )
        gone = tuple(
            f"{item.name} was removed from {item.room} to make room"
            for item in self._base.objects
            if item.fixed and item.name not in view.scene.by_name
        )
        resized = tuple(
            f"{names[each.name]} is scaled by {share:g}: no model of its type meets the requirements"
            for each in binding.additions
            if (share := share_of(view.item(names[each.name]).asset_id)) != 1
        )
        return (*added, *moved, *gone, *resized)

    def _start(self, names: dict[str, str], binding: Binding) -> tuple[InitLiteral, ...]:
        """Return ``:init`` in scene names, without floors, the robot, and negative literals of other states.

        A source of a substance, such as a salt shaker, contains it. Sinks give water without a literal.
        """
        skipped = {
            name
            for name, type_name in self._problem.objects.items()
            if type_name == AGENT or (type_name in FLOORS and name not in names)
        }
        scene_names = {**names, **self._substances, **binding.rooms}
        return tuple(
            InitLiteral(_renamed(literal, scene_names), literal.positive)
            for literal in self._problem.init
            if not skipped & set(literal.atom.args)
            and (literal.positive or literal.atom.predicate in SWITCHED)
            and not self._is_implied(literal.atom)
        )

    def _is_implied(self, atom: Atom) -> bool:
        """True if the atom needs no literal: a future substance, or a substance that its source gives by itself."""
        type_name = self._problem.objects.get(atom.args[0], "")
        if atom.predicate == INSOURCE:
            return self._substances.get(atom.args[1], "") in flows_from(type_name)
        return atom.predicate in (REAL, FUTURE) and is_substance(type_name)


def _renamed(literal: InitLiteral, names: dict[str, str]) -> Atom:
    predicate = literal.atom.predicate
    return Atom(
        SubstanceRelation.CONTAINS.value if predicate == INSOURCE else predicate,
        tuple(names.get(arg, arg) for arg in literal.atom.args),
    )


def _misfit(wrong: LayoutFailure) -> RefusedError:
    return RefusedError(
        RefusalReason.DOES_NOT_FIT,
        f"{wrong.object_name!r} has no place {wrong.relation} {wrong.host}: {wrong.detail}",
        wrong.object_name,
    )


def slug_of(name: str) -> str:
    """Return a problem's name as it stands in the ids of its tasks."""
    return re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:40]
