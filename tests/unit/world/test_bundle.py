"""Bundles survive encoding, have one digest each, and refuse damaged, hostile or foreign data."""

import dataclasses
import zlib

import pytest

from embomatrix.world.bundle import (
    Bundle,
    BundleError,
    BundleLimits,
    bundle_digest,
    decode_bundle,
    encode_bundle,
)
from embomatrix.world.task import Task


def test_bundle_survives_encoding_and_decoding(bundle: Bundle) -> None:
    assert decode_bundle(encode_bundle(bundle)) == bundle


def test_equal_bundles_have_equal_bytes_and_digests(bundle: Bundle) -> None:
    again = decode_bundle(encode_bundle(bundle))
    assert bundle_digest(encode_bundle(again)) == bundle_digest(encode_bundle(bundle))
    assert bundle_digest(encode_bundle(bundle)).startswith("sha256:")


def test_different_content_has_a_different_digest(bundle: Bundle) -> None:
    moved = dataclasses.replace(bundle.scene, seed=8)
    other = dataclasses.replace(bundle, scene=moved)
    assert bundle_digest(encode_bundle(other)) != bundle_digest(encode_bundle(bundle))


def test_wrong_digest_error_names_both_digests(bundle: Bundle) -> None:
    data = encode_bundle(bundle)
    expected = "sha256:" + "0" * 64
    with pytest.raises(BundleError) as caught:
        decode_bundle(data, digest=expected)
    assert expected in str(caught.value)
    assert bundle_digest(data) in str(caught.value)


def test_damaged_bundle_is_refused(bundle: Bundle) -> None:
    data = encode_bundle(bundle)
    for position in range(0, len(data), 37):
        broken = bytearray(data)
        broken[position] ^= 0x55
        with pytest.raises(BundleError):
            decode_bundle(bytes(broken))
    for cut in (0, 1, len(data) // 2, len(data) - 1):
        with pytest.raises(BundleError):
            decode_bundle(data[:cut])
    with pytest.raises(BundleError, match="bytes follow"):
        decode_bundle(data + b"tail")


def test_too_large_a_bundle_is_refused_before_it_is_read(bundle: Bundle) -> None:
    with pytest.raises(BundleError, match="at most 10"):
        decode_bundle(encode_bundle(bundle), limits=BundleLimits(compressed_bytes=10))


def test_decompression_bomb_is_refused() -> None:
    bomb = zlib.compress(b" " * 50_000_000)
    with pytest.raises(BundleError, match="grows beyond"):
        decode_bundle(bomb)


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"format": 1}', "[" * 100_000, '{"format": NaN}', "null"])
def test_compressed_nonsense_is_refused(text: str) -> None:
    with pytest.raises(BundleError):
        decode_bundle(zlib.compress(text.encode()))


def test_bundle_of_another_format_names_both(bundle: Bundle) -> None:
    content = bytearray(zlib.decompress(encode_bundle(bundle)))
    content[4:8] = (9).to_bytes(4, "little")
    with pytest.raises(BundleError, match="has format 9: expected 3; build the dataset again"):
        decode_bundle(zlib.compress(content))


def test_bundle_of_the_first_format_names_the_remedy() -> None:
    with pytest.raises(BundleError, match="build the dataset again"):
        decode_bundle(zlib.compress(b'{"format":1,"scene":{}}'))


@pytest.mark.parametrize("goal", ["(and)", "(and (and) (and))", "(forall (?x - apple.n.01) (and))"])
def test_goal_without_an_atom_is_refused(bundle: Bundle, task: Task, goal: str) -> None:
    """It holds whatever the robot does, and no result of it agrees with its atoms."""
    vacuous = dataclasses.replace(task, goal_bddl=goal)
    with pytest.raises(BundleError, match="goal: has no scored atom"):
        decode_bundle(encode_bundle(dataclasses.replace(bundle, tasks={task.task_id: vacuous})))


def test_goal_with_more_atoms_than_a_result_may_have_is_refused(bundle: Bundle, task: Task) -> None:
    """Each quantifier over two objects doubles the atoms."""
    nested = "(open fridge_1)"
    for number in range(11):
        nested = f"(forall (?x{number} - thing) {nested})"
    many = dataclasses.replace(task, goal_bddl=nested, types={"thing": ("apple_1", "fridge_1")})
    with pytest.raises(BundleError, match="has 2,048 scored atoms"):
        decode_bundle(encode_bundle(dataclasses.replace(bundle, tasks={task.task_id: many})))


def test_task_of_another_scene_is_not_bundled(bundle: Bundle, task: Task) -> None:
    stray = dataclasses.replace(task, scene_id="elsewhere")
    with pytest.raises(BundleError, match="belongs to scene 'elsewhere'"):
        encode_bundle(dataclasses.replace(bundle, tasks={stray.task_id: stray}))


def test_table_of_unknown_objects_is_not_bundled(bundle: Bundle, task: Task) -> None:
    stray = dataclasses.replace(task, table=("apple_1", "fridge_1", "pear_1"))
    with pytest.raises(BundleError, match="'pear_1'"):
        encode_bundle(dataclasses.replace(bundle, tasks={stray.task_id: stray}))
