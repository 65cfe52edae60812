"""Short films of each skill for the skills page, in physical mode: skill_films.py FOLDER  (`make pictures`).

The shipped tasks show most skills: of the plans of the oracle, the one that comes to the skill earliest. Skills that no goal
needs are shown by a call of their own.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

from PIL import Image

from embomatrix.factory.pictures.film import ROOM_PX, draw_film
from embomatrix.sim.film import FRAMES_PER_S
from embomatrix.sim.physical.actor import PhysicalActor
from embomatrix.sim.physical.film import film_physical
from embomatrix.sim.simulation import load_simulator
from embomatrix.skills.parse import plan_from_json
from embomatrix.skills.syntax import Plan, Skill
from embomatrix.starter.shipped import unpack
from embomatrix.world.dataset import Dataset, TaskRecord
from embomatrix.world.task import Profile

SIZE_PX: Final = (400, 300)
MOST_FRAMES: Final = 64
"""Longer motions are shown from their end."""
BEFORE_FRAMES: Final = 4
SHORT_FRAMES: Final = 12
BEFORE_SHORT_FRAMES: Final = 40
"""Frames before a call in which the robot hardly moves, so that one sees what it is about."""
QUALITY: Final = 60
TRIES: Final = 6
"""Tasks of a skill that are tried until the robot's arm and hand are seen to succeed."""
ALONE: Final[Mapping[str, Sequence[Mapping[str, object]]]] = {
    "turn": [{"action": "turn", "yaw": 1.57}],
    "move_forward": [
        {"action": "move_forward", "distance": 1.0, "yaw": yaw} for yaw in (0.0, 1.57, -1.57, 3.14)
    ],
}

WAITS: Final[Mapping[str, tuple[str, str]]] = {
    "heat_object_with_source": ("(hot ", "toggle_on"),
    "cook_object_with_tool": ("(cooked ", "toggle_on"),
    "froze_object_with_source": ("(frozen ", "close"),
}
"""Calls that only wait, which the oracle leaves out: the words of a goal, and the call after which food is at its source."""


def plans_with(dataset: Dataset, skill: str) -> Iterator[tuple[TaskRecord, Plan, int]]:
    """Yield tasks with plans that end with the skill, and the number of its call, the shortest plans first."""
    if skill in ALONE:
        record = next(record for record in dataset.records if record.task.scene_id.startswith("Rs_int"))
        for call in ALONE[skill]:
            yield record, plan_from_json([dict(call)]), 1
        return
    found = []
    for record in dataset.records:
        calls = [dict(call) for call in record.oracle]
        if skill in WAITS:
            found += [(len(long), record.task.task_id, record, long) for long in _waiting(record, skill)]
            continue
        at = next((at for at, call in enumerate(calls) if call["action"] == skill), None)
        if at is not None:
            found.append((at, record.task.task_id, record, calls[: at + 1]))
    if skill == "go_to_room":
        record = dataset.train[0]
        scene = dataset.read_bundle(record.bundle_digest).scene
        for room in scene.rooms[1:]:
            yield record, plan_from_json([{"action": skill, "room_name": room.name}]), 1
    for _, _, record, calls in sorted(found, key=lambda each: each[:2])[:TRIES]:
        yield record, plan_from_json(calls, Profile.HOUSEHOLD), len(calls)


def _waiting(record: TaskRecord, skill: str) -> Iterator[list[dict[str, object]]]:
    """Yield the oracle's calls up to the moment when food is at a source that works, and the call that waits for it."""
    words, last = WAITS[skill]
    if words not in record.task.goal_bddl:
        return
    calls = [dict(call) for call in record.oracle]
    held: object = None
    put: dict[object, object] = {}
    for at, call in enumerate(calls):
        match call["action"]:
            case "pick_up":
                held = call["object_index"]
            case "place":
                put[call["object_index"]] = held
            case action if action == last and call["object_index"] in put:
                food = put[call["object_index"]]
                wait = {"action": skill, "object_index": food, "source_index": call["object_index"]}
                yield [*calls[: at + 1], wait]
                return


def film_of(dataset: Dataset, skill: str) -> list[Image.Image]:
    """Return the pictures of the skill in the first plan in which it succeeds."""
    for record, plan, number in plans_with(dataset, skill):
        bundle = dataset.read_bundle(record.bundle_digest)
        actor = PhysicalActor(bundle)
        film = film_physical(load_simulator(bundle, actor=actor), actor, record.task, plan, 0)
        if len(film.steps) == number and film.steps[-1].ok:
            start = next(at for at, frame in enumerate(film.frames) if frame.step == number)
            still = len(film.frames) - start < SHORT_FRAMES
            before = BEFORE_SHORT_FRAMES if still else BEFORE_FRAMES
            frames = film.frames[max(0, start - before) :][-MOST_FRAMES:]
            shown = replace(film, frames=tuple(replace(frame, step=number) for frame in frames))
            pages = draw_film(shown, [], close=True)
            return [page.crop((0, 0, *ROOM_PX)).resize(SIZE_PX, Image.Resampling.LANCZOS) for page in pages]
    raise SystemExit(f"no shipped task shows {skill}")


def main(folder: Path, skills: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as scratch:
        unpack(Path(scratch))
        dataset = Dataset.load(scratch)
        for skill in skills:
            pictures = film_of(dataset, skill)
            path = folder / f"{skill}.webp"
            durations = [round(1000 / FRAMES_PER_S)] * (len(pictures) - 1) + [1500]
            pictures[0].save(
                path,
                save_all=True,
                append_images=pictures[1:],
                duration=durations,
                loop=0,
                quality=QUALITY,
                method=6,
            )
            sys.stdout.write(f"{path}: {len(pictures)} frames, {path.stat().st_size // 1000} kB\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:] or [*Skill])
