"""Commands on a dataset whose texts are hostile to terminals, and whose oracle plan has an unknown action."""

from dataclasses import replace

import pytest
from tests.fakes.commands import run
from tests.fakes.datasets import write_kitchen_dataset

from embomatrix.world.bundle import Bundle, encode_bundle
from embomatrix.world.dataset import Dataset, write_dataset
from embomatrix.world.inflation import bundle_digest

EVIL = "[/bold][red]\x1b]0;owned\x07\x1b[2J\u009b31m\u202e\nforged: success"
CONTROL = frozenset("\x1b\x07\u009b\u202e")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    kitchen = Dataset.load(write_kitchen_dataset(tmp_path_factory.mktemp("kitchen")))
    record = kitchen.records[0]
    bundle = kitchen.bundle(record.bundle_digest)
    task = replace(record.task, task_id="[red]task", instruction=EVIL)
    data = encode_bundle(Bundle(bundle.scene, {task.task_id: task}))
    digest = bundle_digest(data)
    folder = tmp_path_factory.mktemp("hostile")
    oracle = ({"action": EVIL, "object_index": 1},)
    write_dataset(folder, [replace(record, task=task, bundle_digest=digest, oracle=oracle)], {digest: data})
    return folder


@pytest.mark.parametrize(
    ("command", "status"),
    [
        ("factory list --dataset={}", 0),
        ("play [red]task --oracle --dataset={}", 0),
        ("play [red]task --plan=- --dataset={}", 1),
        ("factory inspect [red]task --dataset={}", 2),
        ("factory verify --dataset={} --physical --jobs=1", 2),
    ],
)
def test_texts_of_a_dataset_are_shown_as_text(folder, command, status):
    plan = '[{"action": "[/bold]\\u001b[2J\\u009b31m", "object_index": 1}]'
    shown = run(*command.format(folder).split(" "), text=plan, COLUMNS="200")
    assert shown.status == status, shown.text
    assert "[red]task" in shown.text
    assert not CONTROL & set(shown.text)
