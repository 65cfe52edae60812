"""Models are chosen by the requirements that a problem puts on its objects."""

import numpy as np
import pytest
from tests.fakes.problems import PROBLEM, source

from embomatrix.factory.admission import RefusalReason, TaskRefusal
from embomatrix.factory.assets.library import build_asset
from embomatrix.factory.scenes.view import is_liftable
from embomatrix.factory.task_import import batch
from embomatrix.factory.task_import.binding import Addition
from embomatrix.factory.task_import.models import models_for
from embomatrix.factory.task_import.size_requirements import (
    CavityFit,
    Requirement,
    requirement_on,
    requirements_of,
    room_for,
    smallest_m,
)
from embomatrix.factory.task_import.sources import EAI_NAMESAKES, LIKE_EAI, activity_names
from embomatrix.factory.task_import.task import ImportedTask, ImportOptions, import_problem
from embomatrix.world.bddl import parse_problem
from embomatrix.world.catalog import Catalog
from embomatrix.world.scene import Scene
from embomatrix.world.state import Relation

BOXES = """(define (problem p) (:domain igibson)
    (:objects book.n.02_1 book.n.02_2 book.n.02_3 - book.n.02 carton.n.02_1 carton.n.02_2 - carton.n.02
        table.n.02_1 - table.n.02 floor.n.01_1 - floor.n.01)
    (:init (ontop book.n.02_1 table.n.02_1) (ontop book.n.02_2 table.n.02_1) (ontop book.n.02_3 table.n.02_1)
        (ontop carton.n.02_1 floor.n.01_1) (ontop carton.n.02_2 floor.n.01_1))
    (:goal (and (forall (?book.n.02 - book.n.02) (exists (?carton.n.02 - carton.n.02) (inside ?book.n.02 ?carton.n.02)))
        (forall (?carton.n.02 - carton.n.02) (ontop ?carton.n.02 floor.n.01_1)))))"""
CARTON = Addition("carton", "carton.n.02", None, "", "kitchen_0")


def model_of(requirement: Requirement, addition: Addition = CARTON):
    return models_for(addition, np.random.default_rng(0), requirement)[0]


def asset_of(model):
    return build_asset(Catalog.load(), model.category, model.model_id)


def test_imported_model_of_the_scene_is_tried_first() -> None:
    generated = models_for(CARTON, np.random.default_rng(0), Requirement())
    last = asset_of(generated[-1])
    chosen = models_for(CARTON, np.random.default_rng(0), Requirement(), imported={last.asset_id: last})
    assert chosen[0] == generated[-1] != generated[0]


def test_contents_are_shared_among_containers_and_static_objects_are_not_carried() -> None:
    requirements = requirements_of(parse_problem(BOXES))
    on_floor = (Relation.ONTOP, "floor.n.01_1")
    assert requirement_on(requirements, "carton.n.02_1", "carton.n.02") == Requirement(
        bears=True, contents=("book.n.02",) * 2, places=(on_floor,)
    )
    assert requirement_on(requirements, "book.n.02_1", "book.n.02") == Requirement(
        carried=True, places=((Relation.ONTOP, "table.n.02_1"), (Relation.INSIDE, "carton.n.02_1"))
    )
    assert requirement_on(requirements, "table.n.02_1", "table.n.02") == Requirement(
        bears=True, burden=("book.n.02",) * 3
    )


def test_negated_places_require_carrying_but_no_space() -> None:
    text = """(define (problem p) (:domain igibson)
        (:objects book.n.02_1 - book.n.02 carton.n.02_1 - carton.n.02 table.n.02_1 - table.n.02)
        (:init (ontop book.n.02_1 table.n.02_1) (inroom table.n.02_1 kitchen))
        (:goal (and (not (ontop book.n.02_1 table.n.02_1)) (not (inside book.n.02_1 carton.n.02_1)))))"""
    requirements = requirements_of(parse_problem(text))
    assert requirements["book.n.02_1"] == Requirement(
        carried=True, places=((Relation.ONTOP, "table.n.02_1"),)
    )
    assert requirements["carton.n.02_1"] == Requirement()


def test_container_has_floor_for_all_contents() -> None:
    plates = ("plate.n.04",) * 4
    model = model_of(Requirement(bears=True, contents=plates))
    assert room_for(asset_of(model), plates) is CavityFit.FOR_ALL
    small = asset_of(model_of(Requirement(bears=True)))
    assert room_for(small, plates) > CavityFit.FOR_ALL


def test_carried_container_is_liftable_whatever_its_contents() -> None:
    model = model_of(Requirement(bears=True, contents=("plate.n.04",) * 9, carried=True))
    assert is_liftable(model.size_m, Catalog.load().category(model.category).mass_kg)


@pytest.mark.parametrize(
    ("contents", "room"),
    [
        ((), CavityFit.FOR_ALL),
        (("rag.n.01",), CavityFit.FOR_SOME),
        (("apple.n.01",) * 30, CavityFit.FOR_EACH),
    ],
)
def test_cavity_fit_depends_on_footprints(contents: tuple[str, ...], room: CavityFit) -> None:
    catalog = Catalog.load()
    bucket = min(catalog.models_of("bucket"), key=lambda model: model.size_m)
    assert room_for(build_asset(catalog, "bucket", bucket.model_id), contents) is room


def test_type_without_models_has_no_size() -> None:
    assert smallest_m("dust.n.01") is None
    assert smallest_m("no_such_thing.n.01") is None


def test_own_scene_is_tried_first_with_several_draws(home: Scene, flat: Scene) -> None:
    item = source(PROBLEM)
    at_home = type(item)(item.name, item.text, item.source, item.request, scene=home.base)
    asked = list(batch.imports(at_home, [flat, home], seed=0, options=ImportOptions(), draws=2))
    first = [found.scene.base for found in asked[:2] if isinstance(found, ImportedTask)]
    assert first == [home.base] * 2
    one, other = (found.scene for found in asked[:2])
    assert one.scene_id != other.scene_id


def test_scene_independent_refusal_ends_the_search(home: Scene, flat: Scene) -> None:
    text = PROBLEM.replace(
        "(not (open ?electric_refrigerator.n.01_1))", "(sliced ?electric_refrigerator.n.01_1)"
    )
    item = source(text)
    at_home = type(item)(item.name, item.text, item.source, item.request, scene=home.base)
    (only,) = batch.imports(at_home, [flat, home], seed=0, options=ImportOptions(), draws=3)
    assert isinstance(only, TaskRefusal)
    assert only.reason is RefusalReason.INEXPRESSIBLE


def test_tap_joins_the_table_when_the_goal_needs_water(home: Scene) -> None:
    text = PROBLEM.replace("(not (open ?electric_refrigerator.n.01_1))", "(soaked ?apple.n.01_1)")
    wet = import_problem(source(text.replace("apple.n.01", "rag.n.01")), home)
    dry = import_problem(source(PROBLEM.replace("apple.n.01", "rag.n.01")), home)
    assert isinstance(wet, ImportedTask)
    assert isinstance(dry, ImportedTask)
    assert not any("sink" in name for name in dry.about)
    assert any("sink" in name for name in wet.task.table)


@pytest.mark.parametrize(
    ("name", "origin", "is_held_out"),
    [
        ("toys", "eai", True),
        ("re-shelving_library_books", "embomatrix", True),
        ("cleaning_oven", "behavior-1k", True),
        ("sweeping_floors", "behavior-1k", True),
        ("cook_a_turkey", "behavior-1k", False),
    ],
)
def test_benchmark_tasks_are_never_training_tasks(
    home: Scene, name: str, origin: str, is_held_out: bool
) -> None:
    item = type(source())(name, PROBLEM, origin)
    imported = import_problem(item, home)
    assert isinstance(imported, ImportedTask)
    assert imported.is_held_out is is_held_out


def test_namesakes_and_near_duplicates_are_activities_of_the_package() -> None:
    assert len(EAI_NAMESAKES) == 67
    assert {name.replace("-", "_") for name in activity_names()} >= EAI_NAMESAKES | LIKE_EAI
    assert not EAI_NAMESAKES & LIKE_EAI
