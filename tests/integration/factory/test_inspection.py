"""The task page is self-contained and escapes all text of the dataset; exports are complete."""

import dataclasses
import json
import re
import shutil
from html.parser import HTMLParser

import pytest
from tests.fakes.datasets import write_kitchen_dataset
from typer.testing import CliRunner

from embomatrix.factory.commands.app import app
from embomatrix.factory.inspection.page import task_page, transcript_html
from embomatrix.factory.inspection.playing import play_oracle
from embomatrix.factory.pipeline.export import FIELDS, dataset_card, encode_rows, export_rows
from embomatrix.pages.plan_view import PlanView
from embomatrix.world.dataset import Dataset, DatasetError

EVIL = '</script><script>alert(1)</script><b onclick="x">'


class _Tags(HTMLParser):
    """Elements of a page and the scripts that a browser would run."""

    def __init__(self, page):
        super().__init__()
        self.tags, self.links, self.scripts = [], [], 0
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        self.tags.append(tag)
        self.scripts += tag == "script" and values.get("type") != "application/json"
        self.links += [values[name] for name in ("src", "href") if name in values]
        assert not [name for name in values if name.startswith("on")]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("shown")
    write_kitchen_dataset(folder)
    return Dataset.load(folder)


@pytest.fixture(scope="module")
def shown(dataset):
    record = dataset.records[0]
    bundle = dataset.bundle(record.bundle_digest)
    return record, bundle.scene, play_oracle(record, bundle)


def test_oracle_plan_is_played_from_start_to_goal(shown):
    record, _, show = shown
    assert len(show.moments) == len(record.oracle) + 1
    assert show.success
    assert not all(holds for _, holds in show.moments[0].goal)
    assert all(holds for _, holds in show.moments[-1].goal)
    assert len({moment.robot_m for moment in show.moments}) > 1


def test_page_is_self_contained_and_shows_every_step_and_object(shown):
    record, scene, show = shown
    page = task_page(record, scene, show)
    tags = _Tags(page)
    assert all(link.startswith("data:") for link in tags.links)
    assert tags.scripts == 1
    assert tags.tags.count("svg") == 1
    assert page.count("data-step=") == len(show.moments)
    moments = json.loads(re.search(r'id="moments">(.*?)</script>', page, re.DOTALL)[1])
    assert len(moments) == len(show.moments)
    for name in record.task.table:
        assert f"<td>{name}</td>" in page


def test_dataset_text_never_becomes_markup(shown):
    record, scene, show = shown
    task = dataclasses.replace(record.task, instruction=EVIL, goal_bddl=EVIL, task_id=EVIL)
    evil = dataclasses.replace(record, task=task, signature=EVIL, rooms=(EVIL,))
    moments = tuple(
        dataclasses.replace(moment, call=EVIL, said=EVIL, goal=((EVIL, True),)) for moment in show.moments
    )
    loud = dataclasses.replace(show, moments=moments, final=(EVIL,))
    page = task_page(
        evil, scene, loud, transcript=f"# x\n\n## {EVIL}\n\n* **{EVIL}**\n\n{EVIL}", tree={EVIL: [EVIL]}
    )
    tags = _Tags(page)
    assert tags.scripts == 1
    assert "<b onclick" not in page
    assert "alert(1)</script>" not in page


def test_transcript_keeps_headings_lists_and_bold_words():
    text = "# Instruction\n\n## The people\n\n* **Mia**, 40\n* **Hugo**, 9\n\n**Mia** (need): I can't.\n"
    assert transcript_html(text) == (
        "<h3>The people</h3><ul><li><strong>Mia</strong>, 40</li><li><strong>Hugo</strong>, 9</li></ul>"
        "<p><strong>Mia</strong> (need): I can&#x27;t.</p>"
    )


def test_plan_is_north_up_and_contains_its_rooms(shown):
    _, scene, _ = shown
    view = PlanView(scene, [room.name for room in scene.rooms])
    room = scene.rooms[0]
    left, bottom = view.at(*room.low_m)
    right, top = view.at(*room.high_m)
    assert 0 < left < right < view.size[0]
    assert 0 < top < bottom < view.size[1]


def test_inspect_writes_a_page_and_suggests_close_task_ids(dataset, tmp_path):
    task_id, out = dataset.records[0].task.task_id, tmp_path / "task.html"
    done = CliRunner().invoke(
        app, ["inspect", task_id, "--dataset", str(dataset.folder), "--out", str(out), "--no-picture"]
    )
    assert done.exit_code == 0, done.output
    assert out.read_text().startswith("<!doctype html>")
    wrong = CliRunner().invoke(
        app, ["inspect", f"{task_id}x", "--dataset", str(dataset.folder), "--out", str(out)]
    )
    assert wrong.exit_code == 2
    assert "did you mean" in wrong.output


def test_scene_pictures_are_rendered_once(dataset, tmp_path):
    folder = tmp_path / "data"
    shutil.copytree(dataset.folder, folder)
    done = [CliRunner().invoke(app, ["pictures", "--dataset", str(folder)]) for _ in range(2)]
    bundles = {record.bundle_digest.removeprefix("sha256:") for record in dataset.records}
    assert {file.stem for file in (folder / "pictures").glob("*.jpg")} == bundles
    assert [result.output.split(" pictures")[0].split()[-1] for result in done] == [f"{len(bundles)}", "0"]
    wrong = CliRunner().invoke(app, ["pictures", "--dataset", str(tmp_path / "nowhere")])
    assert (wrong.exit_code, "there is no dataset" in " ".join(wrong.output.split())) == (2, True)


@pytest.mark.parametrize(
    ("source", "licence", "origin"),
    [
        ("society", "license: mit", "they are unknown."),
        ("writer", "license: mit", "they are unknown."),
        ("behavior-1k", "license: mit", "these tasks were imported."),
        ("eai", "license: other", "these tasks were imported."),
        ("file", "license: other", "these tasks were imported."),
    ],
)
def test_card_of_a_folder_without_settings_tells_the_origin_by_the_sources(
    dataset, tmp_path, source, licence, origin
):
    records = tuple(
        dataclasses.replace(each, task=dataclasses.replace(each.task, source=source))
        for each in dataset.records
    )
    card = dataset_card(Dataset(tmp_path, records), "t.jsonl", b"")
    assert licence in card.splitlines()
    assert f"The folder holds no build settings: {origin}" in card


def test_export_replaces_its_own_files_but_no_others(dataset, tmp_path):
    def export(*options):
        return CliRunner().invoke(
            app, ["export", "--dataset", str(dataset.folder), "--out", str(tmp_path / "t.jsonl"), *options]
        )

    notes = tmp_path / "README.md"
    notes.write_text("my notes")
    refused = export()
    assert refused.exit_code == 2
    assert "README.md was not written by an export" in " ".join(refused.stderr.split())
    assert notes.read_text() == "my notes"
    assert not (tmp_path / "t.jsonl").exists()
    assert export("--force").exit_code == 0
    assert export().exit_code == 0, "its own files may be replaced"
    notes.unlink()
    assert "t.jsonl was not written by an export" in " ".join(export().stderr.split())


def test_every_task_is_exported_with_every_field(dataset):
    rows = export_rows(dataset)
    assert [row["task_id"] for row in rows] == [record.task.task_id for record in dataset.records]
    assert all(list(row) == list(FIELDS) for row in rows)
    assert [json.loads(line) for line in encode_rows(rows, ".jsonl").decode().splitlines()] == rows


def test_parquet_holds_the_same_rows(dataset, tmp_path):
    parquet = pytest.importorskip(
        "pyarrow.parquet", reason="pyarrow is not installed: pip install 'embomatrix[export]'"
    )
    rows = export_rows(dataset)
    path = tmp_path / "tasks.parquet"
    path.write_bytes(encode_rows(rows, ".parquet"))
    assert parquet.read_table(path).to_pylist() == rows


def test_hub_library_reads_file_and_card(dataset, tmp_path):
    library = pytest.importorskip("datasets", reason="datasets is not installed: pip install datasets")
    pytest.importorskip("pyarrow", reason="pyarrow is not installed: pip install 'embomatrix[export]'")
    folder, cache = tmp_path / "export", str(tmp_path / "cache")
    done = CliRunner().invoke(
        app, ["export", "--dataset", str(dataset.folder), "--out", str(folder / "tasks.parquet")]
    )
    assert done.exit_code == 0, done.output
    (read,) = library.load_dataset(str(folder), cache_dir=cache).values()
    assert list(read.features) == list(FIELDS)
    assert read.to_list() == export_rows(dataset)
    alone = library.load_dataset("parquet", data_files=str(folder / "tasks.parquet"), cache_dir=cache)
    assert alone["train"].to_list() == export_rows(dataset)


def test_unknown_export_suffix_is_refused(dataset):
    with pytest.raises(DatasetError, match=r"expected \.jsonl or \.parquet"):
        encode_rows(export_rows(dataset), ".csv")


def test_card_counts_tasks_and_explains_every_field(dataset):
    text = dataset_card(dataset, "tasks.jsonl", b"abc")
    assert "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad" in text
    assert f"| all | {len(dataset.train)} | {len(dataset.heldout)} |" in text
    assert all(f"| `{name}` |" in text for name in FIELDS)
    assert "imported" in text
    assert "## Licences" in text
    assert "`bddl` 3.6.0: MIT licence" in text


def test_export_writes_the_card_beside_the_file(dataset, tmp_path):
    done = CliRunner().invoke(
        app, ["export", "--dataset", str(dataset.folder), "--out", str(tmp_path / "hub" / "tasks.jsonl")]
    )
    assert done.exit_code == 0, done.output
    assert (tmp_path / "hub" / "README.md").read_text().startswith("---\n")
    assert (tmp_path / "hub" / "tasks.jsonl").read_text().count("\n") == len(dataset.records)
