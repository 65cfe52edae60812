"""Gymnasium environment: an action is one skill call, an observation a dict of texts, and rewards add up to a plan's.

Needs ``gymnasium``, which no other module needs. The import registers ``ENV_ID``, so after it
``gymnasium.make("EmboMatrix/Household-v0", dataset="build/dataset")`` works.
"""

import math
import string
from pathlib import Path
from typing import Any, Final, SupportsFloat

import numpy as np
from numpy.typing import NDArray

try:
    import gymnasium
    from gymnasium import spaces
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        f"embomatrix.envs.gym needs the package {error.name}: pip install 'gymnasium>=1.1'", name=error.name
    ) from None

from embomatrix.envs.episode import Episode, EpisodeStep, Household
from embomatrix.reward.hierarchy import unparsable
from embomatrix.sim.film_stage import RoomCamera
from embomatrix.skills.limits import ROBOT
from embomatrix.skills.parse import PlanError, PlanReason, parse_plan
from embomatrix.skills.syntax import PROFILES, SIGNATURES, Arg, PlaceRelation, SkillCall
from embomatrix.world.dataset import SPLITS, DatasetError
from embomatrix.world.task import MAX_TABLE, Profile

ENV_ID: Final = "EmboMatrix/Household-v0"
RENDER_MODES: Final = ("ansi", "rgb_array")
PICTURE_PX: Final = (640, 480)
RESET_OPTIONS: Final = ("task_id",)
SKILLS: Final = PROFILES[Profile.HOUSEHOLD]
RELATIONS: Final = tuple(PlaceRelation)
MOST_ROOMS: Final = 32
CHARACTERS: Final = string.printable
LONGEST_TEXT: Final = 32_768
LONGEST_ACTION: Final = 256


class HouseholdEnv(gymnasium.Env[dict[str, Any], dict[str, Any]]):
    """Tasks of a dataset, one per episode: ``reset(seed=…)`` draws one, ``options={"task_id": …}`` names it.

    *Action*, a dict: ``skill`` (in the order of ``SKILLS``), ``object`` and ``source`` (rows of the object table),
    ``relation`` (in the order of ``RELATIONS``), ``room`` (in the order of ``info["rooms"]``), ``yaw`` (rad), ``distance``
    (m). Arguments that the skill does not take are ignored. Or a text with one call, such as ``"move 3"``; with
    ``text_actions`` the action space is of such texts. Text without exactly one call changes nothing, gains −1 and has the
    failure ``unparsable``. ``info["action_mask"]`` marks skills, rows and rooms that exist in the task, as
    ``action_space.sample(mask=…)`` takes it; a call with them may still fail.

    *Observation*, a dict of texts: ``task`` (the prompt, constant), ``state`` (one line per object), ``message`` (the outcome
    of the last call).

    *Rendering*: with ``render_mode="ansi"`` the state in words; with ``"rgb_array"`` the robot's room from above, RGB values of
    shape (480, 640, 3), as ``gymnasium.wrappers.RecordVideo`` takes them.

    The reward of a step is its gain. An episode terminates at the goal and is truncated after 64 calls; a failed call changes
    nothing.
    """

    metadata: dict[str, Any] = {"render_modes": [*RENDER_MODES], "render_fps": 1}  # noqa: RUF012  # declared so by gymnasium

    def __init__(
        self,
        dataset: str | Path,
        split: str = "train",
        render_mode: str | None = None,
        *,
        text_actions: bool = False,
    ) -> None:
        if split not in SPLITS:
            raise ValueError(f"a dataset has no split {split!r}: expected {' or '.join(SPLITS)}")
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(f"render_mode {render_mode!r}: expected {' or '.join(RENDER_MODES)}, or None")
        self.render_mode = render_mode
        self._household = Household(dataset)
        self._task_ids = [record.task.task_id for record in self._household.records if record.split == split]
        if not self._task_ids:
            raise DatasetError(f"the dataset at {dataset} has no task of the split {split!r}: pass another")
        self._episode: Episode | None = None
        self._camera: RoomCamera | None = None
        self._message = ""
        self._calls = spaces.Dict(
            {
                "skill": spaces.Discrete(len(SKILLS)),
                "object": spaces.Discrete(MAX_TABLE),
                "source": spaces.Discrete(MAX_TABLE),
                "relation": spaces.Discrete(len(RELATIONS)),
                "room": spaces.Discrete(MOST_ROOMS),
                "yaw": spaces.Box(-math.pi, math.pi, (), np.float64),
                "distance": spaces.Box(0.0, ROBOT.max_step_m, (), np.float64),
            }
        )
        self.action_space: spaces.Space[Any] = (
            spaces.Text(LONGEST_ACTION, min_length=0, charset=CHARACTERS) if text_actions else self._calls
        )
        text = spaces.Text(LONGEST_TEXT, min_length=0, charset=CHARACTERS)
        self.observation_space = spaces.Dict({"task": text, "state": text, "message": text})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start an episode. Raises DatasetError for an unknown task, ValueError for an unknown option."""
        super().reset(seed=seed)
        unknown = sorted(set(options or {}) - set(RESET_OPTIONS))
        if unknown:
            raise ValueError(f"reset has no option {unknown[0]!r}: expected {', '.join(RESET_OPTIONS)}")
        drawn = self._task_ids[int(self.np_random.integers(len(self._task_ids)))]
        self._episode = self._household.episode(str((options or {}).get("task_id", drawn)))
        self._episode.reset(int(self.np_random.integers(2**31)))
        self._message = ""
        return self._observed(self._episode), {
            "task_id": self._episode.task.task_id,
            "rooms": self._episode.situation.home,
            "objects": self._episode.task.table,
            "action_mask": mask_of(self._episode),
        }

    def step(
        self, action: dict[str, Any] | str
    ) -> tuple[dict[str, Any], SupportsFloat, bool, bool, dict[str, Any]]:
        """Execute one call. ``info`` has the reward's tiers, success, and the reason of a failed call.

        Raises ValueError for a dict that is no action.
        """
        episode = self._episode
        if episode is None:
            raise RuntimeError("no episode was begun: call reset() first")
        try:
            call = self._call(action, episode)
        except PlanError as error:
            self._message = str(error)
            over = episode.skip()
            info = {"failure": "unparsable", "success": False}
            return self._observed(episode), unparsable().total, False, over, info
        outcome = episode.act(call)
        self._message = outcome.step.message
        success = outcome.reward.success
        return (
            self._observed(episode),
            outcome.gain,
            success,
            outcome.over and not success,
            step_info(outcome),
        )

    def _call(self, action: dict[str, Any] | str, episode: Episode) -> SkillCall:
        """Return the call of an action. Raises PlanError for a text, ValueError for a dict."""
        if isinstance(action, str):
            plan = parse_plan(action, episode.task.profile)
            if len(plan) != 1:
                raise PlanError(PlanReason.TOO_MANY_STEPS, f"{len(plan)} calls: expected one for each step")
            return plan[0]
        missing = sorted(self._calls.spaces.keys() - action.keys()) if isinstance(action, dict) else []
        if missing or not isinstance(action, dict):
            lacks = f"lacks {', '.join(missing)}" if missing else f"is {type(action).__name__}"
            raise ValueError(
                f"the action {lacks}: expected a dict with {', '.join(self._calls.spaces)}, or a text with one call"
            )
        for name, space in self._calls.spaces.items():
            _check_number(name, action[name], int(space.n) if isinstance(space, spaces.Discrete) else None)
        return call_of(action, episode.situation.home)

    def render(self) -> str | NDArray[np.uint8] | None:
        """State in words, or a picture of the robot's room, by ``render_mode``. Raises EngineError without pybullet."""
        if self._episode is None or self.render_mode is None:
            return None
        if self.render_mode == "ansi":
            return "\n".join([*self._episode.state(), self._message])
        if self._camera is None or self._camera.scene is not self._episode.scene:
            self._close_camera()
            self._camera = RoomCamera(self._episode.scene)
        return self._camera.shoot(self._episode.frame(), *PICTURE_PX)

    def close(self) -> None:
        self._close_camera()
        self._household.close()

    def _close_camera(self) -> None:
        if self._camera is not None:
            self._camera.close()
            self._camera = None

    def _observed(self, episode: Episode) -> dict[str, Any]:
        prompt = episode.prompt()
        texts = {
            "task": f"{prompt.system}\n\n{prompt.user}",
            "state": "\n".join(episode.state()),
            "message": self._message,
        }
        return {name: _plain(text) for name, text in texts.items()}


def mask_of(episode: Episode) -> dict[str, Any]:
    """Mask of the action space: skills of the task's profile, rows of its table and rooms of its scene."""
    if len(episode.situation.home) > MOST_ROOMS:
        raise ValueError(
            f"the scene {episode.task.scene_id} has {len(episode.situation.home)} rooms: at most {MOST_ROOMS} fit into the "
            "action space; play it with embomatrix.envs.make, which takes texts"
        )
    rows = (np.arange(MAX_TABLE) < len(episode.task.table)).astype(np.int8)
    skills = np.array([skill in PROFILES[episode.task.profile] for skill in SKILLS], dtype=np.int8)
    rooms = (np.arange(MOST_ROOMS) < len(episode.situation.home)).astype(np.int8)
    everything = np.ones(len(RELATIONS), dtype=np.int8)
    return {
        "skill": skills,
        "object": rows,
        "source": rows,
        "relation": everything,
        "room": rooms,
        "yaw": None,
        "distance": None,
    }


def call_of(action: dict[str, Any], rooms: tuple[str, ...]) -> SkillCall:
    """Skill call of an action. A room index out of range gives an unknown room's name."""
    skill = SKILLS[int(action["skill"])]
    room = int(action["room"])
    values: dict[Arg, Any] = {
        Arg.OBJECT: int(action["object"]),
        Arg.SOURCE: int(action["source"]),
        Arg.RELATION: RELATIONS[int(action["relation"])],
        Arg.YAW: float(action["yaw"]),
        Arg.DISTANCE: float(action["distance"]),
        Arg.ROOM: rooms[room] if room < len(rooms) else f"room_{room}",
    }
    return SkillCall(skill, **{argument.value: values[argument] for argument in SIGNATURES[skill]})


def action_of(call: SkillCall, rooms: tuple[str, ...]) -> dict[str, Any]:
    """Inverse of ``call_of``, for oracle plans. Raises ValueError for an unknown room."""
    return {
        "skill": SKILLS.index(call.skill),
        "object": call.object_index or 0,
        "source": call.source_index or 0,
        "relation": RELATIONS.index(call.relation) if call.relation is not None else 0,
        "room": rooms.index(call.room_name) if call.room_name is not None else 0,
        "yaw": np.asarray(call.yaw or 0.0),
        "distance": np.asarray(call.distance or 0.0),
    }


def step_info(outcome: EpisodeStep) -> dict[str, Any]:
    """Entries of ``info`` for a step."""
    reward = outcome.reward
    return {
        "success": reward.success,
        "failure": outcome.step.failure.value if outcome.step.failure is not None else "",
        **reward.tiers,
    }


def _check_number(name: str, value: Any, count: int | None) -> None:
    """Raise ValueError for a value that isn't a whole number below ``count``, or a finite number if that is None."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if count is None:
        valid, expected = math.isfinite(number), "a finite number"
    else:
        valid, expected = number.is_integer() and 0 <= number < count, f"a whole number from 0 to {count - 1}"
    if not valid:
        raise ValueError(f"the action's {name} is {value!r}: expected {expected}")


def _plain(text: str) -> str:
    """Restrict text to the characters and the length of the observation space."""
    return "".join(letter if letter in CHARACTERS else "?" for letter in text[:LONGEST_TEXT])


if ENV_ID not in gymnasium.registry:
    gymnasium.register(ENV_ID, entry_point="embomatrix.envs.gym:HouseholdEnv")
