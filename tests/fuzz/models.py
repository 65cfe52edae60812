"""Decoders of answers of language models, model files, briefs, and files of the factory."""

from __future__ import annotations

import contextlib
import functools
import gzip
import json
import logging
import lzma
import random
import struct
from dataclasses import asdict

import httpx
import trimesh
from tests.fuzz.decoder import Decoder, in_file, mutate_bytes, mutate_json, mutate_json_lines, text_of
from tests.fuzz.world import record_line

from embomatrix.factory.days.agent_interfaces import SOCIAL_AGENTS
from embomatrix.factory.evaluate.admissions import evaluate_admissions
from embomatrix.factory.evaluate.difficulty import read_policy_shares
from embomatrix.factory.evaluate.faithfulness import read_answers
from embomatrix.factory.evaluate.judges import DiversityScores, Impression
from embomatrix.factory.evaluate.readings import parse_goal
from embomatrix.factory.evaluate.readings import read_answers as read_readings
from embomatrix.factory.evaluate.room_plans import read_rooms
from embomatrix.factory.evaluate.scenes import LayoutMethod, LayoutOutcome, _models_in, outcome_log
from embomatrix.factory.importers.convex import _kept as kept_pieces
from embomatrix.factory.importers.meshes import read_groups
from embomatrix.factory.importers.model import ModelFileError
from embomatrix.factory.importers.urdf import read_urdf
from embomatrix.factory.layout.agent_interfaces import LAYOUT_AGENTS, AgentName, BriefError
from embomatrix.factory.layout.model_agents import ModelLayoutAgents
from embomatrix.factory.layout.values import (
    ConstraintBrief,
    DistributionBrief,
    HostFacts,
    HostOffer,
    LayoutRelation,
    LayoutRoomFacts,
    ObjectBrief,
    RoomBrief,
)
from embomatrix.factory.metrics.figures import (
    EvaluationError,
    EvaluationFigures,
    evaluation_to_json,
    read_evaluation,
)
from embomatrix.factory.pipeline.export import merge_in_words
from embomatrix.factory.pipeline.merge import MERGED_FILE
from embomatrix.factory.pipeline.store import (
    ATTEMPTS_FILE,
    BUILD_FILE,
    TIMES_FILE,
    BuildStore,
    build_settings,
)
from embomatrix.factory.social.model.answers import (
    DayAnswer,
    PeopleAnswer,
    PersonTurn,
    ReadingAnswer,
    RobotTurn,
    RoomSighting,
    SummaryAnswer,
)
from embomatrix.factory.social.values import Cast
from embomatrix.llm.cassette import Cassette
from embomatrix.llm.endpoint import _Failure, _judged, _reply
from embomatrix.llm.ledger import Ledger, Price
from embomatrix.llm.structured import read_json
from embomatrix.llm.values import CassetteError, ChatRequest, Reply, Usage
from embomatrix.pages.figures import Better, Figure
from embomatrix.starter.archive import read_packed
from embomatrix.starter.shipped import frozen_tasks
from embomatrix.world.dataset import DatasetError

# Language models

SHAPES = (
    Cast,
    PeopleAnswer,
    DayAnswer,
    PersonTurn,
    RobotTurn,
    SummaryAnswer,
    ReadingAnswer,
    RoomSighting,
    DiversityScores,
    Impression,
)
CAST = {
    "setting": "a flat",
    "people": [{"name": name, "age": 30, "job": "cook", "hobby": "chess"} for name in ("Ann", "Ben")],
    "day": [{"time": "07:30", "person": "Ann", "room": "kitchen_0", "activity": "makes tea"}],
}
ROOM = LayoutRoomFacts("kitchen_0", "kitchen", (4.0, 3.0), ("table",))
THINGS = (
    ObjectBrief("cup_1", "cup", (0.1, 0.1, 0.1)),
    ObjectBrief("tray_1", "tray", (0.4, 0.3, 0.05), relation=LayoutRelation.ONTOP, host="table_1"),
)
TABLE = HostFacts("table_1", "table", (HostOffer(LayoutRelation.ONTOP, ((1.0, 0.8, 1.0),), 0.7),))
ROOM_BRIEF = RoomBrief(ROOM, (TABLE,), THINGS)
PLANE_BRIEF = ConstraintBrief("table_1 top", "table", THINGS, (("lamp_1", "lamp"),))
SPREAD_BRIEF = DistributionBrief((ROOM,), THINGS, {"table_1": "kitchen_0"})


def _chat_reply(data: bytes) -> object:
    """Read the body of an endpoint's answer, and do with its text what a conversation does next."""
    found = _judged(httpx.Response(200), data)
    if isinstance(found, _Failure):
        return found.found.encode()
    reply = _reply(found, "model", 0.1, 0)
    httpx.Request("POST", "http://localhost", json={"content": reply.text}).read()
    json.dumps(asdict(reply), ensure_ascii=False).encode()
    Ledger(_Parrot(reply.text), price=Price(0.5, 1.5))._cost(reply)
    return reply


def _cassette(data: bytes) -> object:
    return Cassette(in_file("cassette.jsonl", data))


def _typed_answer(data: bytes) -> object:
    """Read a model's text as each of the typed answers."""
    text, found = text_of(data), []
    for shape in SHAPES:
        try:
            found.append(read_json(text, shape))
        except ValueError:
            continue
        json.dumps(found[-1].model_dump(mode="json"), ensure_ascii=False).encode()
    return found


class _Parrot:
    """Model that always gives the same answer."""

    def __init__(self, text: str) -> None:
        self._text = text

    async def complete(self, request: ChatRequest) -> Reply:
        return Reply(self._text, "parrot", Usage(), "stop", 0.0)


def _layout_answer(data: bytes) -> object:
    """Lay out a room with a model that gives this text as its answer; rules replace unusable answers."""
    logging.getLogger("embomatrix.factory.layout").setLevel(logging.ERROR)
    with ModelLayoutAgents(_Parrot(text_of(data)), attempts=1) as agents:
        spread = agents.distribute(SPREAD_BRIEF)
        tree = agents.organize(ROOM_BRIEF)
        chosen = agents.choose_constraints(PLANE_BRIEF)
    return spread, tree.drawn().encode(), json.dumps(tree.nested(), ensure_ascii=False).encode(), chosen


BRIEFS = (*SOCIAL_AGENTS.values(), *LAYOUT_AGENTS.values())


def _brief(data: bytes) -> object:
    """Read the brief of one of the factory's agents, which the first byte selects; the layout's rules answer it."""
    interface = BRIEFS[data[0] % len(BRIEFS)] if data else BRIEFS[0]
    value = interface.read(data[1:].decode("utf-8", "replace"))
    again = interface.read(interface.brief.dump_json(value).decode())
    assert again == value
    return value


def _briefs() -> list[bytes]:
    names = (*SOCIAL_AGENTS, *LAYOUT_AGENTS)
    values = {
        AgentName.DISTRIBUTOR: SPREAD_BRIEF,
        AgentName.ORGANIZER: ROOM_BRIEF,
        AgentName.PLANNER: PLANE_BRIEF,
    }
    found = [
        bytes([names.index(name)]) + LAYOUT_AGENTS[name].brief.dump_json(value)
        for name, value in values.items()
    ]
    scene = b'{"scene": "Rs_int", "seed": 3}'
    talk = json.dumps({"scene": "Rs_int", "cast": CAST, "seed": 3}).encode()
    plane = b'{"plane": "top", "size_m": [1, 1], "objects": [{"name": "cup", "size_m": [0.1, 0.1, 0.1]}]}'
    return [
        *found,
        b"\x00" + scene,
        b"\x02" + talk,
        bytes([names.index(AgentName.SOLVER)]) + plane,
        bytes([names.index(AgentName.SAMPLER)])
        + b'{"scene": "Rs_int", "category": "cup", "host": "table_1"}',
    ]


def _mutate_brief(data: bytes, rng: random.Random) -> bytes:
    return data[:1] + mutate_json(data[1:], rng)


# Model files

URDF = b"""<robot name="box"><link name="base"><inertial><mass value="1"/></inertial>
<collision><origin xyz="0 0 0.1" rpy="0 0 1.57"/><geometry><box size="0.4 0.3 0.2"/></geometry></collision></link>
<link name="lid"><visual><geometry><cylinder radius="0.1" length="0.02"/></geometry></visual>
<visual><geometry><sphere radius="0.1"/></geometry></visual>
<visual><geometry><mesh filename="package://part.obj" scale="1 1 1"/></geometry></visual></link>
<joint name="hinge" type="revolute"><parent link="base"/><child link="lid"/><axis xyz="0 1 0"/>
<limit lower="0" upper="1.5"/></joint>
</robot>"""
OBJ = b"o base\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\ng lid part\nf 1/1 3/2 -1/3\nf 2 3 4 1\n"


def _urdf(data: bytes) -> object:
    in_file("model/part.obj", OBJ)
    return read_urdf(in_file("model/robot.urdf", data))


def _mesh(suffix: str, data: bytes) -> object:
    return read_groups(in_file(f"mesh{suffix}", data))


@functools.cache
def _box(kind: str) -> bytes:
    made: bytes = trimesh.creation.box().export(file_type=kind)
    return made


def _mutate_glb(data: bytes, rng: random.Random) -> bytes:
    """Return a GLB file with a change in its JSON or in its buffer; the lengths in its head fit."""
    if rng.random() < 0.2 or len(data) < 20:
        return mutate_bytes(data, rng)
    size = struct.unpack_from("<I", data, 12)[0]
    text, rest = data[20 : 20 + size], data[20 + size :]
    if rng.random() < 0.3:
        rest = mutate_bytes(rest, rng)
    else:
        text = mutate_json(text, rng)
        text += b" " * (-len(text) % 4)
    body = struct.pack("<I", len(text)) + data[16:20] + text + rest
    return data[:8] + struct.pack("<I", len(body) + 12) + body


def _pieces(data: bytes) -> object:
    return kept_pieces(in_file("pieces.json", data))


# Files of the factory


def _readings(data: bytes) -> object:
    answers = read_readings(in_file("answers.jsonl", data))
    for each in answers:
        with contextlib.suppress(EvaluationError):
            parse_goal(each.goal, ("cup_1", "table_1"))
    return answers


def _shares(data: bytes) -> object:
    return read_policy_shares(in_file("report.json", data))


def _merged(data: bytes) -> object:
    return merge_in_words(in_file(MERGED_FILE, data).parent)


def _evaluation(data: bytes) -> object:
    found = read_evaluation(in_file("evaluation.json", data))
    evaluation_to_json(found)
    return found


def _rooms(data: bytes) -> object:
    """Read a table of rooms. The bytes are its JSON, or in gzip format the file itself."""
    packed = data if data[:2] == b"\x1f\x8b" else gzip.compress(data, 1)
    return read_rooms(in_file("rooms.json.gz", packed))


def _policy_answers(data: bytes) -> object:
    return read_answers(in_file("answers.jsonl", data))


def _ledger(data: bytes) -> object:
    """Evaluate a build's ledger: drafts, times and settings, separated by zero bytes."""
    drafts, times, settings = (*data.split(b"\x00", 2), b"", b"")[:3]
    folder = in_file(f"ledger/{ATTEMPTS_FILE}", drafts).parent
    in_file(f"ledger/{TIMES_FILE}", times)
    in_file(f"ledger/{BUILD_FILE}", settings)
    return evaluate_admissions(folder)


def _build(data: bytes) -> object:
    folder = in_file(f"build/{BUILD_FILE}", data).parent
    settings = build_settings(folder)
    return BuildStore(folder, settings).results


def _layout_outcomes(data: bytes) -> object:
    return outcome_log(in_file("outcomes.jsonl", data), 3).outcomes


def _packed(data: bytes) -> object:
    return read_packed(in_file("tasks.xz", lzma.compress(data)))[0]


def _frozen(data: bytes) -> object:
    return frozen_tasks(in_file("frozen.json", data))


def table() -> dict[str, Decoder]:
    """Return the decoders of this module by name."""
    reply = (
        b'{"choices": [{"message": {"content": "{\\"a\\": 1} \\ud83d"}, "finish_reason": "stop"}], "model": "m",'
        b' "usage": {"prompt_tokens": 3, "completion_tokens": 2}}'
    )
    recorded = (
        b'{"question": "q", "number": 0, "purpose": "p", "text": "a\xe2\x80\xa8b", "model": "m", "prompt_tokens": 1,'
        b' "completion_tokens": 1, "finish": "stop"}\n'
    )
    summary = {
        "requests": [
            {
                "instruction": "Please put the cup on the table.",
                "wish": {
                    "objects": [
                        {"label": "table", "kind": "coffee_table", "room": "kitchen_0", "furniture": True},
                        {"label": "cup", "kind": "mug", "room": "kitchen_0"},
                    ],
                    "conditions": [{"predicate": "ontop", "things": "cup", "place": "table"}],
                },
            }
        ]
    }
    reading = {"answers": [{"conditions": [{"predicate": "ontop", "thing": "cup", "place": "table"}]}]}
    event = {**CAST["day"][0], "needs": ["The cup should be on the table."]}
    typed = [
        json.dumps(value).encode()
        for value in (
            CAST,
            {key: CAST[key] for key in ("setting", "people")},
            {"events": [event, event]},
            {"act": "need", "text": "The cup is missing."},
            {"act": "confirm", "text": "I will bring it."},
            summary,
            reading,
            {"rooms": {"kitchen_0": "A bright kitchen with a table."}},
            {"variety": 3, "characters": 4, "overall": 5, "explanation": "varied"},
        )
    ]
    typed.append(b"<think>{</think>```json\n" + typed[0] + b"\n``` [1")
    laid = [
        b'{"rooms": {"cup_1": "kitchen_0", "tray_1": "kitchen_0"}}',
        b'{"branches": [{"parent": "table_1", "relation": "ontop", "child": "tray_1"},'
        b' {"parent": "tray_1", "relation": "ontop", "child": "cup_1"}]}',
        b'{"of": {"cup_1": [{"kind": "near", "other": "lamp_1"}, {"kind": "edge"}]}}',
    ]
    figures = EvaluationFigures(
        "layout", {"seed": 3}, (Figure("share", 0.5, "%", Better.HIGHER, 4, 0.4),), ("note",)
    )
    evaluation = json.dumps(evaluation_to_json(figures)).encode()
    things = [
        ["Floor", "", [0, 0, 0], 0.0, [0, -0.2, 0], [9, 0.4, 9], [], 1.0],
        ["TVStand", "a", [1, 0, 0], 91.0, [1, 0.3, 0], [0.4, 0.6, 1.2], ["Floor"], 9.0],
        ["Vase", "b", [1, 0.6, 0.2], 33.0, [1, 0.7, 0.2], [0.1, 0.2, 0.1], ["TVStand"], 1.0],
    ]
    rooms = json.dumps({"rooms": [{"kind": "bedrooms", "objects": things}]}).encode()
    drafts = (
        b'{"split": "train", "variant": 0, "scene": "Rs_int-0", "outcome": "admitted"}\n'
        b'{"split": "train", "variant": 1, "scene": "Rs_int-0", "outcome": "no_plan"}'
    )
    settings = b'{"settings": {"seed": 3, "writer": "social"}}\n'
    variant = b'{"split": "train", "number": 0, "records": [' + record_line() + b'], "rejections": []}\n'
    outcome = LayoutOutcome("t", "Rs_int", LayoutMethod.TREE, True, True, False, "", 1.0, (0.5,), 6.0)
    layout = b'{"seed": 3}\n' + json.dumps(asdict(outcome)).encode()
    packed = (
        b'{"sizes": [6], "records": ['
        + record_line().replace(b'"sha256:' + b"0" * 64 + b'"', b"0")
        + b"]}\nabcdef"
    )
    frozen = b'{"digest": "sha256:0", "tasks": ["a", "b"]}'
    return {
        "chat reply": Decoder(
            _chat_reply, (), lambda: (reply, b"[" * 5_000), frozenset({"llm.endpoint:_judged"}), mutate_json
        ),
        "cassette": Decoder(
            _cassette,
            (CassetteError,),
            lambda: (recorded, recorded * 2),
            frozenset({"llm.cassette:_read"}),
            mutate_json_lines,
        ),
        "models of a recording": Decoder(
            _models_in,
            (),
            lambda: (recorded, recorded * 2),
            frozenset({"factory.evaluate.scenes:_models_in"}),
            mutate_json_lines,
        ),
        "typed answer": Decoder(
            _typed_answer,
            (),
            lambda: typed,
            frozenset({"llm.structured:_json_values", "llm.structured:read_json"}),
            mutate_json,
        ),
        "layout answer": Decoder(
            _layout_answer, (), lambda: laid, frozenset({"llm.structured:read_json"}), mutate_json
        ),
        "brief": Decoder(
            _brief,
            (BriefError,),
            _briefs,
            frozenset({"factory.layout.agent_interfaces:AgentInterface.read"}),
            _mutate_brief,
        ),
        "URDF": Decoder(
            _urdf,
            (ModelFileError,),
            lambda: (URDF,),
            frozenset({"factory.importers.urdf:read_urdf"}),
            mutate_bytes,
        ),
        "OBJ": Decoder(
            functools.partial(_mesh, ".obj"), (ModelFileError,), lambda: (OBJ,), frozenset(), mutate_bytes
        ),
        "STL": Decoder(
            functools.partial(_mesh, ".stl"),
            (ModelFileError,),
            lambda: (
                _box("stl"),
                b"solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
                b"endloop\nendfacet\nendsolid a\n",
            ),
            frozenset({"factory.importers.meshes:_binary"}),
            mutate_bytes,
        ),
        "GLB": Decoder(
            functools.partial(_mesh, ".glb"),
            (ModelFileError,),
            lambda: (_box("glb"),),
            frozenset({"factory.importers.meshes:_binary"}),
            _mutate_glb,
        ),
        "convex pieces": Decoder(
            _pieces,
            (),
            lambda: (b"[[[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]]",),
            frozenset({"factory.importers.convex:_kept"}),
            mutate_json,
        ),
        "evaluation": Decoder(
            _evaluation,
            (EvaluationError,),
            lambda: (evaluation,),
            frozenset({"factory.metrics.figures:read_evaluation"}),
            mutate_json,
        ),
        "hand-made rooms": Decoder(
            _rooms,
            (EvaluationError,),
            lambda: (rooms, gzip.compress(rooms)),
            frozenset({"factory.evaluate.room_plans:read_rooms"}),
            mutate_json,
        ),
        "answers to audit": Decoder(
            _policy_answers,
            (DatasetError,),
            lambda: (b'{"codec": "json"}\n{"task_id": "t", "text": "[]"}', b'{"codec": "names"}\n\n[1]'),
            frozenset({"factory.evaluate.faithfulness:read_answers"}),
            mutate_json,
        ),
        "ledger of a build": Decoder(
            _ledger,
            (EvaluationError, DatasetError),
            lambda: (
                b"\x00".join(
                    (drafts, b'{"split": "train", "variant": 0, "cpu_s": 1.5}\n{"cpu_s": 2}', settings)
                ),
            ),
            frozenset(
                {
                    "factory.evaluate.admissions:_attempts",
                    "factory.evaluate.admissions:_times",
                    "factory.pipeline.store:build_settings",
                }
            ),
            _mutate_parts,
        ),
        "build": Decoder(
            _build,
            (DatasetError,),
            lambda: (settings, settings + variant),
            frozenset(
                {
                    "factory.pipeline.store:ResumableLog.resume",
                    "factory.pipeline.store:_read_outcomes",
                    "factory.pipeline.store:build_settings",
                }
            ),
            mutate_json_lines,
        ),
        "layout outcomes": Decoder(
            _layout_outcomes,
            (DatasetError,),
            lambda: (layout,),
            frozenset({"factory.pipeline.store:_read_outcomes"}),
            mutate_json_lines,
        ),
        "answers of a reader": Decoder(
            _readings,
            (EvaluationError,),
            lambda: (b'{"task": "t", "plan": "move 1", "goal": "(and (ontop 0 1) (exactly 1 (open 1)))"}',),
            frozenset({"factory.evaluate.readings:read_answers"}),
            mutate_json_lines,
        ),
        "report with verdicts": Decoder(
            _shares,
            (EvaluationError,),
            lambda: (b'{"verdicts": [{"task": "t", "samples": [{"success": true}, {"lost": true}]}]}',),
            frozenset({"factory.evaluate.difficulty:read_policy_shares"}),
            mutate_json,
        ),
        "sources of a merge": Decoder(
            _merged,
            (DatasetError,),
            lambda: (b'[{"name": "a", "tasks": 3, "digest": "sha256:0"}]',),
            frozenset({"factory.pipeline.export:merge_in_words"}),
            mutate_json,
        ),
        "packed dataset": Decoder(
            _packed,
            (DatasetError,),
            lambda: (packed,),
            frozenset({"starter.archive:read_packed"}),
            mutate_json_lines,
        ),
        "frozen tasks": Decoder(
            _frozen,
            (DatasetError,),
            lambda: (frozen,),
            frozenset({"starter.shipped:frozen_tasks"}),
            mutate_json,
        ),
    }


def _mutate_parts(data: bytes, rng: random.Random) -> bytes:
    """Apply ``mutate_json_lines`` to one of the parts that zero bytes separate."""
    parts = data.split(b"\x00")
    at = rng.randrange(len(parts))
    parts[at] = mutate_json_lines(parts[at], rng)
    return b"\x00".join(parts)
