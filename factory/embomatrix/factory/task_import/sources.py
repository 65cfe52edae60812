"""Sources of BDDL problems: BEHAVIOR-1K's activities, EAI's tasks, a file, or a JSON lines file."""

import difflib
import importlib.util
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from embomatrix.world.json_text import parse_json
from embomatrix.world.whole_file import read_whole

MAX_PROBLEM_BYTES: Final = 1024 * 1024
MAX_RECORDS_BYTES: Final = 256 * 1024 * 1024
"""Twice the size of a hundred thousand tasks as the paper's factory writes them."""

BEHAVIOR: Final = "behavior-1k"
EAI: Final = "eai"
EAI_FOLDER: Final = "behavior_eval"
EAI_PROBLEMS: Final = "evaluation/transition_modeling/resources/pddl_behavior"
EAI_INSTRUCTIONS: Final = "evaluation/goal_interpretation/resources/data/instructions_by_activity_name.json"

_NAMESAKES: Final = (
    "assembling_gift_baskets boxing_books_up_for_storage bringing_in_wood brushing_lint_off_clothing "
    "cleaning_barbecue_grill cleaning_bathrooms cleaning_bathtub cleaning_bedroom cleaning_carpets "
    "cleaning_floors cleaning_freezer cleaning_garage cleaning_high_chair cleaning_kitchen_cupboard "
    "cleaning_microwave_oven cleaning_out_drawers cleaning_oven cleaning_shoes cleaning_sneakers "
    "cleaning_stove cleaning_table_after_clearing cleaning_the_hot_tub cleaning_the_pool cleaning_toilet "
    "cleaning_up_after_a_meal cleaning_up_refrigerator cleaning_windows clearing_the_table_after_dinner "
    "collecting_aluminum_cans defrosting_freezer installing_a_fax_machine installing_a_modem "
    "installing_a_printer installing_a_scanner installing_alarms laying_tile_floors laying_wood_floors "
    "loading_the_dishwasher mopping_floors moving_boxes_to_storage organizing_boxes_in_garage "
    "organizing_file_cabinet organizing_school_stuff packing_bags_or_suitcase packing_car_for_trip "
    "picking_up_take_out_food picking_up_trash polishing_furniture polishing_shoes polishing_silver "
    "putting_away_Christmas_decorations putting_away_Halloween_decorations putting_away_toys "
    "putting_dishes_away_after_cleaning putting_leftovers_away putting_up_Christmas_decorations_inside "
    "re_shelving_library_books rearranging_furniture serving_hors_d_oeuvres setting_mousetraps sorting_mail "
    "storing_food thawing_frozen_food unpacking_suitcase vacuuming_floors washing_floor washing_pots_and_pans"
)
EAI_NAMESAKES: Final = frozenset(_NAMESAKES.split())
"""BEHAVIOR-1K activities that share a name with a task of EAI. Training on them would contaminate that evaluation."""

ALIKE: Final = 1 / 3
"""Likeness of goals from which an activity counts as a near-duplicate of an EAI task (`likeness.likeness`)."""
_LIKE_EAI: Final = (
    "clean_a_broiler_pan clean_a_felt_pool_table_top clean_outdoor_tiles clean_vans cleaning_camper_or_RV cleaning_vehicles "
    "mopping_the_kitchen_floor preserving_fruit sweeping_floors sweeping_garage vacuuming_vehicles watering_outdoor_flowers "
    "waxing_floors"
)
LIKE_EAI: Final = frozenset(_LIKE_EAI.split())
"""BEHAVIOR-1K activities with other names whose goals are like that of a task of EAI: near-duplicates of that evaluation."""


class ProblemSourceError(ValueError):
    """Source that can't be read. The message is a sentence with the remedy."""


@dataclass(frozen=True, slots=True)
class SourceText:
    """Text of one problem. ``request`` is the instruction; if it is empty, the problem's name is the instruction.

    ``scene`` is the base scene that the problem was written for; empty means any scene. ``scenes`` lists those that
    its author finds suitable. ``instruction`` is used as it is, unlike ``request``, in which room names are replaced.
    """

    name: str
    text: str
    source: str
    request: str = ""
    scene: str = ""
    scenes: tuple[str, ...] = ()
    instruction: str = ""

    @property
    def named_scenes(self) -> tuple[str, ...]:
        """Base scenes that the problem's author names; empty means any scene."""
        return (self.scene,) if self.scene else self.scenes

    @property
    def is_held_out(self) -> bool:
        """True for EAI's tasks, their namesakes and near-duplicates: for evaluation only, never for training."""
        return self.source == EAI or self.name.replace("-", "_") in EAI_NAMESAKES | LIKE_EAI


def activity_names() -> tuple[str, ...]:
    """Return the activities of the installed ``bddl`` package. Raise ProblemSourceError if it is missing."""
    return tuple(sorted(path.parent.name for path in _definitions().glob("*/problem0.bddl")))


def read_activity(name: str) -> SourceText:
    """Return an activity of BEHAVIOR-1K. Raise ProblemSourceError that names close matches."""
    path = _definitions() / name / "problem0.bddl"
    if "/" in name or not path.is_file():
        close = difflib.get_close_matches(name, activity_names(), n=3)
        hint = f"did you mean {', '.join(close)}?" if close else "see the package's activity_manifest.txt"
        raise ProblemSourceError(f"there is no activity {name!r} in the bddl package: {hint}")
    return SourceText(name, path.read_text(encoding="utf-8"), BEHAVIOR, request=name.replace("_", " "))


def read_file(path: Path) -> SourceText:
    """Return the problem of a ``.bddl`` file. Raise ProblemSourceError."""
    return SourceText(path.stem, _read(path, at_most=MAX_PROBLEM_BYTES), "file")


def read_jsonl(path: Path) -> Iterator[SourceText]:
    """Yield the problems of a JSON lines file with the fields ``name`` and ``bddl``, and optional ``scenes``.

    Raise ProblemSourceError that names the line.
    """
    for number, line in enumerate(_read(path).split("\n"), start=1):
        if not line.strip():
            continue
        try:
            record = parse_json(line)
            name, text = record["name"], record["bddl"]
            scenes = tuple(map(str, record.get("scenes", ())))
        except (ValueError, KeyError, TypeError) as error:
            raise ProblemSourceError(f"{path}:{number}: expected an object with 'name' and 'bddl'") from error
        yield SourceText(str(name), str(text), "embomatrix", scenes=scenes)


def read_eai(folder: Path) -> tuple[SourceText, ...]:
    """Return the tasks of EAI's BEHAVIOR split, from the package's folder ``behavior_eval`` or its parent.

    BEHAVIOR-100's ``onfloor`` is read as ``ontop``. Raise ProblemSourceError if files are missing.
    """
    root = folder / EAI_FOLDER if (folder / EAI_FOLDER).is_dir() else folder
    try:
        stats = parse_json(_read(root / "data" / "demo_stats.json"))
        words = parse_json(_read(root / EAI_INSTRUCTIONS))
        return tuple(
            SourceText(
                name=demo["task"],
                text=_in_our_bddl(_read(root / EAI_PROBLEMS / f"{name}.pddl")),
                source=EAI,
                request=words[demo["task"]],
                scene=demo["scene_id"],
            )
            for name, demo in sorted(stats.items())
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ProblemSourceError(
            f"{folder} contains no tasks of EAI ({error}): unpack the wheel of eai-eval 1.0.5 and name the folder "
            f"that contains {EAI_FOLDER}"
        ) from error


def _in_our_bddl(text: str) -> str:
    return text.replace("(onfloor ", "(ontop ").replace(" home_office)", " private_office)")


def _read(path: Path, *, at_most: int = MAX_RECORDS_BYTES) -> str:
    try:
        return read_whole(path, at_most=at_most).decode("utf-8")
    except OSError as error:
        raise ProblemSourceError(
            f"{path} can't be read ({error.strerror}): expected a file of BDDL problems"
        ) from error
    except UnicodeDecodeError as error:
        raise ProblemSourceError(f"{path} is not UTF-8 text: expected BDDL problems") from error


def _definitions() -> Path:
    spec = importlib.util.find_spec("bddl")
    if spec is None or spec.origin is None:
        raise ProblemSourceError(
            "BEHAVIOR-1K's activities need the package bddl: install it with `pip install bddl==3.6.0`"
        )
    return Path(spec.origin).parent / "activity_definitions"
