"""Inputs that would crash, hang or silently corrupt physics are refused early.

Each kind is tried at three gates: bundles and scene files, which carry all outside data, and the engine itself, for scenes
built in code. Messages name what was found.
"""

import dataclasses
import json
import math
import time
import zlib

import numpy as np
import pytest
from tests.fakes.scenes import kitchen_scene

from embomatrix.sim.bullet.engine import BulletEngine
from embomatrix.sim.engine import BACKGROUND, FLOOR, WALL, EngineError
from embomatrix.world.asset import Joint, JointKind, Link
from embomatrix.world.bundle import Bundle, decode_bundle, encode_bundle, read_bundle
from embomatrix.world.codec import RESERVED_NAMES, scene_from_json, scene_to_json
from embomatrix.world.geometry import ConvexPart, Pose, Shape
from embomatrix.world.inflation import BundleError
from embomatrix.world.records import SceneInvalidError

NAN, INF = math.nan, math.inf
ORIGIN = (0.0, 0.0, 0.0)
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
BOX = ConvexPart(Shape.BOX, Pose(ORIGIN), (0.1, 0.1, 0.1))
HINGE = Joint(JointKind.REVOLUTE, ORIGIN, (0.0, 0.0, 1.0), 1.0)
CUBE = tuple((x, y, z) for x in (-0.05, 0.05) for y in (-0.05, 0.05) for z in (-0.05, 0.05))


def with_object(**changes):
    """Return the flat with its last object changed: the apple or another small object."""
    scene = kitchen_scene()
    return dataclasses.replace(
        scene, objects=(*scene.objects[:-1], dataclasses.replace(scene.objects[-1], **changes))
    )


def with_asset(**changes):
    """Return the flat with the asset of its last object changed."""
    scene = kitchen_scene()
    asset = dataclasses.replace(scene.assets[scene.objects[-1].asset_id], **changes)
    joints = (0.0,) * len(asset.joints)
    scene = dataclasses.replace(scene, assets={**scene.assets, asset.asset_id: asset})
    return dataclasses.replace(
        scene, objects=(*scene.objects[:-1], dataclasses.replace(scene.objects[-1], joints=joints))
    )


def with_links(*links):
    return with_asset(links=links, supports=(), interiors=())


def with_part(part):
    return with_links(Link("base", (part,)))


def hull(vertices):
    return with_part(ConvexPart(Shape.HULL, Pose(ORIGIN), (0.1, 0.1, 0.1), tuple(vertices)))


def with_joint(**changes):
    return with_links(Link("base", (BOX,)), Link("lid", (BOX,), dataclasses.replace(HINGE, **changes)))


def with_fractions(fractions):
    scene = with_joint()
    return dataclasses.replace(
        scene, objects=(*scene.objects[:-1], dataclasses.replace(scene.objects[-1], joints=fractions))
    )


def sphere_of(count):
    angles = np.arange(count)
    points = np.stack([np.sin(angles), np.cos(angles), np.sin(angles * 0.7)], axis=1) / 10
    return [tuple(point) for point in points.tolist()]


def named(name):
    return with_object(name=name)


def in_a_circle():
    scene = kitchen_scene()
    *rest, one, other = scene.objects
    return dataclasses.replace(
        scene,
        objects=(
            *rest,
            dataclasses.replace(one, host=other.name),
            dataclasses.replace(other, host=one.name),
        ),
    )


def at_one_point():
    scene = kitchen_scene()
    return with_object(pose_world_asset=scene.objects[0].pose_world_asset)


def twice_the_same():
    scene = kitchen_scene()
    return dataclasses.replace(scene, objects=(*scene.objects, scene.objects[0]))


def with_room(**changes):
    scene = kitchen_scene()
    return dataclasses.replace(
        scene, rooms=(*scene.rooms[:-1], dataclasses.replace(scene.rooms[-1], **changes))
    )


PHYSICAL = {
    "position that is no number": lambda: with_object(pose_world_asset=Pose((NAN, 0.0, 1.0))),
    "infinite position": lambda: with_object(pose_world_asset=Pose((INF, 0.0, 1.0))),
    "position at 1e30 m": lambda: with_object(pose_world_asset=Pose((1e30, 0.0, 1.0))),
    "zero quaternion": lambda: with_object(pose_world_asset=Pose((1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 0.0))),
    "quaternion of length 7": lambda: with_object(
        pose_world_asset=Pose((1.0, 1.0, 1.0), (0.0, 0.0, 0.0, 7.0))
    ),
    "quaternion that is no number": lambda: with_object(
        pose_world_asset=Pose((1.0, 1.0, 1.0), (NAN, 0.0, 0.0, 1.0))
    ),
    "mass that is no number": lambda: with_asset(mass_kg=NAN),
    "no mass": lambda: with_asset(mass_kg=0.0),
    "negative mass": lambda: with_asset(mass_kg=-1.0),
    "extent that is no number": lambda: with_part(dataclasses.replace(BOX, size_m=(NAN, 0.1, 0.1))),
    "no extent": lambda: with_part(dataclasses.replace(BOX, size_m=ORIGIN)),
    "negative extent": lambda: with_part(dataclasses.replace(BOX, size_m=(-0.1, 0.1, 0.1))),
    "part that is nowhere": lambda: with_part(dataclasses.replace(BOX, pose=Pose((NAN, 0.0, 0.0)))),
    "no link": with_links,
    "no part": lambda: with_links(Link("base", ())),
    "17 parts of a link": lambda: with_links(Link("base", (BOX,) * 17)),
    "40 parts of a link": lambda: with_links(Link("base", (BOX,) * 40)),
    "140 links": lambda: with_links(
        Link("base", (BOX,)), *(Link(f"l{number}", (BOX,), HINGE) for number in range(140))
    ),
    "112 hulls": lambda: with_links(
        *(
            Link(
                f"l{number}",
                (ConvexPart(Shape.HULL, Pose(ORIGIN), (0.1, 0.1, 0.1), CUBE),) * 16,
                HINGE if number else None,
            )
            for number in range(7)
        )
    ),
    "two roots": lambda: with_links(Link("base", (BOX,)), Link("second", (BOX,))),
    "root on a joint": lambda: with_links(Link("base", (BOX,), HINGE)),
    "zero axis": lambda: with_joint(axis=ORIGIN),
    "axis that is no number": lambda: with_joint(axis=(NAN, 0.0, 0.0)),
    "axis of length 3": lambda: with_joint(axis=(0.0, 0.0, 3.0)),
    "joint without travel": lambda: with_joint(upper=0.0),
    "travel that is no number": lambda: with_joint(upper=NAN),
    "joint that is nowhere": lambda: with_joint(origin_m=(INF, 0.0, 0.0)),
    "joint position that is no number": lambda: with_fractions((NAN,)),
    "joint beyond its travel": lambda: with_fractions((1.5,)),
    "joint positions of another asset": lambda: with_fractions((0.0, 0.0)),
    "no joint positions": lambda: with_fractions(()),
    "hull without vertices": lambda: hull(()),
    "hull of three vertices": lambda: hull(CUBE[:3]),
    "hull of one point": lambda: hull([(0.1, 0.1, 0.1)] * 8),
    "flat hull": lambda: hull([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 1.0, 0.0)]),
    "hull with a vertex that is no number": lambda: hull([(NAN, 0.0, 0.0), *CUBE]),
    "hull of 20,000 vertices": lambda: hull(sphere_of(20_000)),
    "two of a name": twice_the_same,
    "unknown asset": lambda: with_object(asset_id="ghost-abcdef"),
    "object named like the walls": lambda: named(WALL),
    "object named like the floor": lambda: named(FLOOR),
}
"""Invalid for physics itself: all three gates refuse it."""
OUTSIDE = {
    "box with vertices": lambda: with_part(dataclasses.replace(BOX, vertices_m=CUBE)),
    "objects that rest on one another in a circle": in_a_circle,
    "object that rests on itself": lambda: with_object(host=kitchen_scene().objects[-1].name),
    "unknown host": lambda: with_object(host="ghost_1"),
    "unknown room": lambda: with_object(room="attic_0"),
    "unknown piece": lambda: with_object(pieces=("ghost_1",)),
    "two objects at one point": at_one_point,
    "no room": lambda: dataclasses.replace(kitchen_scene(), rooms=()),
    "room inside out": lambda: with_room(high_m=(0.0, 0.0)),
    "room as large as a country": lambda: with_room(high_m=(9e5, 9e5)),
    "room without end": lambda: with_room(high_m=(1e300, 1e300)),
    "path for a name": lambda: named("../../etc/passwd"),
    "absolute path for a name": lambda: named("/dev/zero"),
    "path of another system for a name": lambda: named("C:\\pagefile.sys"),
    "name with a line's end": lambda: named("apple\n1"),
    "name of a megabyte": lambda: named("x" * 1_000_000),
    "path for an asset": lambda: dataclasses.replace(
        with_asset(asset_id="../mesh.obj"),
        assets={
            "../mesh.obj": dataclasses.replace(
                next(iter(kitchen_scene().assets.values())), asset_id="../mesh.obj"
            )
        },
    ),
    "40,000 objects": lambda: dataclasses.replace(
        kitchen_scene(), objects=kitchen_scene().objects[-1:] * 40_000
    ),
}
"""Invalid only for bundles and scene files: the engine never checks it."""
EVERYTHING = PHYSICAL | OUTSIDE


@pytest.mark.parametrize("kind", EVERYTHING)
def test_invalid_bundle_raises_bundle_error(kind):
    started_s = time.process_time()
    # Encoding refuses numbers that JSON lacks; decoding refuses everything else.
    with pytest.raises(ValueError) as caught:
        decode_bundle(encode_bundle(Bundle(EVERYTHING[kind](), {})))
    assert isinstance(caught.value, BundleError) or "not JSON compliant" in str(caught.value)
    assert time.process_time() - started_s < 5.0


@pytest.mark.parametrize("kind", EVERYTHING)
def test_invalid_scene_error_names_the_field(kind):
    with pytest.raises(SceneInvalidError) as caught:
        scene_from_json(scene_to_json(EVERYTHING[kind]()))
    assert caught.value.field.startswith("scene.")


@pytest.mark.parametrize("kind", PHYSICAL)
def test_engine_refuses_invalid_scene(kind):
    with pytest.raises(EngineError, match=r"expected|one on each link|called|rename"):
        BulletEngine(PHYSICAL[kind]())


def test_unmodified_flat_is_valid():
    scene = kitchen_scene()
    assert decode_bundle(encode_bundle(Bundle(scene, {}))).scene == scene
    assert decode_bundle(encode_bundle(Bundle(hull(CUBE), {}))).scene == hull(CUBE)
    assert {WALL, FLOOR, BACKGROUND} == RESERVED_NAMES


def test_scene_file_with_400_000_objects_is_refused_quickly():
    value = scene_to_json(kitchen_scene())
    value["objects"] *= 400_000 // len(value["objects"]) + 1
    started_s = time.process_time()
    with pytest.raises(SceneInvalidError, match="length <= 5000"):
        scene_from_json(value)
    assert time.process_time() - started_s < 1.0


def test_gigabyte_file_is_refused_before_reading(tmp_path):
    path = tmp_path / "scene.bundle"
    with path.open("wb") as file:
        file.truncate(1 << 30)
    started_s = time.process_time()
    with pytest.raises(BundleError, match="over 8,388,608 bytes"):
        read_bundle(path)
    assert time.process_time() - started_s < 1.0


def test_decompression_bomb_of_a_gigabyte_is_refused():
    packer = zlib.compressobj(9)
    data = b"".join(packer.compress(b" " * (1 << 20)) for _ in range(1024)) + packer.flush()
    with pytest.raises(BundleError, match="grows beyond"):
        decode_bundle(data)


def _respun(change):
    """Return the flat's bundle with JSON and arrays changed by a function, as an attacker would."""
    content = bytearray(zlib.decompress(encode_bundle(Bundle(kitchen_scene(), {}))))
    length = int.from_bytes(content[8:12], "little")
    value, rest = json.loads(content[12 : 12 + length]), bytes(content[12 + length :])
    value, rest = change(value, rest)
    text = json.dumps(value, separators=(",", ":")).encode()
    text += b" " * (-(12 + len(text)) % 8)
    return zlib.compress(bytes(content[:8]) + len(text).to_bytes(4, "little") + text + rest)


def _edit(*path, to):
    def change(value, rest):
        place = value
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = to
        return value, rest

    return change


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (_edit("scene", "objects", 0, "pose", to=10**6), "expected a row"),
        (_edit("scene", "objects", 0, "pose", to=-1), "expected a row"),
        (_edit("scene", "objects", 0, "pose", to=True), "expected `int | array`, got `bool`"),
        (_edit("scene", "objects", 0, "pose", to=[0.0] * 7), "expected a row"),
        (_edit("scene", "walls", 0, to=0.5), "expected `int | object`, got `float`"),
        (_edit("poses", "stands", to={"apple_1": [0, 5]}), "there are 0"),
        (_edit("poses", "stands", to={"apple_1": "all"}), "expected `array`, got `str`"),
        (_edit("arrays", "poses", 1, to=10**12), "asks for"),
        (_edit("arrays", "poses", 1, to=-1), "expected numbers from 0"),
        (_edit("arrays", "poses", 0, to="|O"), "expected one of"),
        (_edit("arrays", "poses", 0, to="<i4"), "more|expected|describes"),
        (_edit("arrays", to={}), "describes 0 bytes"),
        (_edit("arrays", to=[]), "expected `object`, got `array`"),
        (lambda value, rest: (value, rest[:-8]), "asks for|describes"),
        (lambda value, rest: (value, rest + bytes(8)), "describes"),
        (lambda value, rest: (value, np.full(len(rest) // 8, np.nan).tobytes()), "not finite"),
        (lambda value, rest: (value, bytes(len(rest))), "quaternion"),
        (lambda value, rest: ([], rest), "expected `object`, got `array`"),
    ],
)
def test_mismatched_arrays_are_refused(change, found):
    with pytest.raises(BundleError, match=found):
        decode_bundle(_respun(change))


def test_any_corrupted_byte_raises_only_bundle_error():
    content = zlib.decompress(encode_bundle(Bundle(kitchen_scene(), {})))
    for position in range(0, len(content), max(1, len(content) // 300)):
        broken = bytearray(content)
        broken[position] ^= 0x41
        try:
            decode_bundle(zlib.compress(broken, 1))
        except BundleError:
            continue
