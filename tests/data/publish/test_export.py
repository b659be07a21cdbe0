"""`datasets` loads from an export the same records and frames that the store contains."""

from __future__ import annotations

import base64
import io
import re
import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import yaml
from datasets import load_dataset
from huggingface_hub import DatasetCard
from PIL import Image

from dynapix.conf.schema import TeacherConfig
from dynapix.conf.schema.benchmark import MATCHED_ANCHOR, POOLS
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.publish import huggingface
from dynapix.data.publish.columns import DESCRIPTIONS, dataset_features
from dynapix.data.publish.huggingface import ensure_export, render_card
from dynapix.data.publish.leaderboard import CELL_WIDTH, EVAL_FILE, GAP
from dynapix.data.records import (
    Rationale,
    RetrievalQuery,
    SelectionItem,
    sample_prefix_frames,
)
from dynapix.data.store import Store
from dynapix.teacher.narrate import narrate_store
from tests.user_errors import raises_user_error

pytestmark = pytest.mark.slow

TABLES = ("selection", "matched_anchor", "retrieval", "database", "rationales")
"""The tables of the small benchmark, which has no interventions."""


@pytest.fixture(scope="module")
def exported(micro_store: Store, tmp_path_factory) -> Path:
    """An export of the small benchmark with images, in several files per split, and rationales."""
    narrate_store(micro_store, TeacherConfig(name="template"))
    folder = tmp_path_factory.mktemp("exports") / "micro"
    with pytest.MonkeyPatch.context() as small:
        small.setattr(huggingface, "GROUP_IMAGES", 64)
        small.setattr(huggingface, "SHARD_GROUPS", 5)
        ensure_export({"micro": micro_store}, folder, images=True)
    return folder


@pytest.fixture(scope="module")
def loaded(exported: Path, tmp_path_factory) -> dict:
    cache = str(tmp_path_factory.mktemp("cache"))
    return {name: load_dataset(str(exported), name, cache_dir=cache) for name in TABLES}


def test_loaded_records_equal_the_stores_records(micro_store, loaded) -> None:
    for split in ("train", "test"):
        items, queries = loaded["selection"][split], loaded["retrieval"][split]
        kept = [f.name for f in fields(SelectionItem)]
        rows = [SelectionItem.from_row(r) for r in items.select_columns(kept)]
        assert rows == micro_store.selection(split)
        pairs = micro_store.selection(split, MATCHED_ANCHOR)
        assert bool(pairs) == (split in loaded["matched_anchor"])
        if pairs:
            rows = loaded["matched_anchor"][split].select_columns(kept)
            assert [SelectionItem.from_row(r) for r in rows] == pairs
        kept = [f.name for f in fields(RetrievalQuery)]
        rows = [RetrievalQuery.from_row(r) for r in queries.select_columns(kept)]
        assert rows == [q for pool in POOLS for q in micro_store.retrieval(split, pool)]
    texts = {r.item_id: r.text for r in micro_store.rationales()}
    rationales = loaded["rationales"]["train"]
    assert dict(zip(rationales["item_id"], rationales["text"], strict=True)) == texts
    assert len(texts) > 100
    for name, frames in loaded["database"].items():
        references = frames.select_columns(["scene_id", "frame"])
        assert [tuple(r.values()) for r in references] == [
            (f.scene_id, f.frame) for f in micro_store.database(name)
        ]


def test_images_are_the_frames_that_their_row_names(micro_store, loaded) -> None:
    frames = FrameReader(micro_store)

    def same(image, scene_id: str, frame: int) -> None:
        assert np.array_equal(np.asarray(image), frames.array(scene_id, frame))

    selection, retrieval, database = (
        loaded[name]["test"].select(range(0, loaded[name]["test"].num_rows, 5))
        for name in ("selection", "retrieval", "database")
    )
    for row in selection:
        frames_of_prefix = sample_prefix_frames(row["prefix_start"], row["prefix_stop"], 12)
        assert row["prefix_frames"] == frames_of_prefix
        assert row["prefix_times"] == pytest.approx([f / row["fps"] for f in frames_of_prefix])
        assert row["fps"] == micro_store.scene(row["scene_id"]).fps
        for image, frame in zip(row["prefix_images"], frames_of_prefix, strict=True):
            same(image, row["scene_id"], frame)
        for image, candidate in zip(row["candidate_images"], row["candidates"], strict=True):
            same(image, candidate["scene_id"], candidate["frame"])
    for row in retrieval:
        same(row["target_image"], **row["target"])
        same(row["prefix_images"][-1], row["scene_id"], row["prefix_stop"])
        for image, frame in zip(row["hard_negative_images"], row["hard_negatives"], strict=True):
            same(image, **frame)
    for row in database:
        same(row["image"], row["scene_id"], row["frame"])


def test_without_images_the_columns_are_the_records_fields(micro_store, tmp_path) -> None:
    columns = {name: set(kinds) for name, kinds in dataset_features(images=False).items()}
    derived = {"fps", "prefix_frames", "prefix_times"}
    assert columns["selection"] == {f.name for f in fields(SelectionItem)} | derived
    assert columns["matched_anchor"] == columns["interventions"] == columns["selection"]
    assert columns["retrieval"] == {f.name for f in fields(RetrievalQuery)} | derived
    assert columns["rationales"] <= {f.name for f in fields(Rationale)} | {"split"}
    store = without_rationales(micro_store, tmp_path / "copy")
    shards = ensure_export({"micro": store}, tmp_path / "out", images=False)
    assert len(shards) == len({(s["configuration"], s["split"]) for s in shards}) == 8
    assert sum(s["bytes"] for s in shards) < 200_000
    for shard in shards:
        schema = pq.read_schema(tmp_path / "out" / shard["path"])
        assert set(schema.names) == columns[shard["configuration"]] <= set(DESCRIPTIONS)


def without_rationales(store: Store, folder: Path) -> Store:
    copy = Store(folder / store.name, store.manifest)
    shutil.copytree(store.folder, copy.folder, ignore=shutil.ignore_patterns("rationales*"))
    return copy


def test_pandas_reads_integers_as_integers(micro_store, exported) -> None:
    items = pd.concat(map(pd.read_parquet, sorted((exported / "selection").glob("test-*"))))
    gaps = {i.item_id: i.gap for i in micro_store.selection("test")}
    assert None in gaps.values()
    assert items.gap.dtype == items.answer.dtype == "Int64"
    found = dict(zip(items.item_id, items.gap, strict=True))
    assert {k: None if pd.isna(gap) else gap for k, gap in found.items()} == gaps


def test_rows_are_streamed(exported, loaded) -> None:
    streamed = load_dataset(str(exported), "selection", split="test", streaming=True)
    for row, expected in zip(streamed.take(5), loaded["selection"]["test"], strict=False):
        assert row["item_id"] == expected["item_id"]
        assert np.array_equal(*(np.asarray(r["prefix_images"][0]) for r in (row, expected)))


def test_several_benchmarks_are_in_one_dataset(micro_store, tmp_path) -> None:
    stores = {"micro": micro_store, "other": without_rationales(micro_store, tmp_path / "copy")}
    shards = ensure_export(stores, tmp_path / "out", images=False)
    names = {shard["configuration"] for shard in shards}
    assert names == {f"micro-{t}" for t in TABLES} | {f"other-{t}" for t in TABLES[:-1]}
    card = DatasetCard.load(tmp_path / "out" / "README.md")
    assert {c["config_name"] for c in card.data.configs} == names
    assert [c["config_name"] for c in card.data.configs if c["default"]] == ["micro-selection"]
    rows = {(s["configuration"], s["split"]): s["rows"] for s in shards}
    for (name, split), count in rows.items():
        assert f"| {name} | {split} | {count:,} |" in card.text
        found = load_dataset(str(tmp_path / "out"), name, split=split, cache_dir=tmp_path / "cache")
        assert len(found) == count
    # Code of the card names variables.
    code = re.search(r"```python\n(.*?)```", card.text, re.DOTALL)[1]
    compile(code, "card", "exec")


def test_a_later_narration_is_another_export(micro_store, tmp_path) -> None:
    store = without_rationales(micro_store, tmp_path / "copy")
    ensure_export({"micro": store}, tmp_path / "out", images=False)
    narrate_store(store, TeacherConfig(name="template"), limit=5)
    with raises_user_error("other-settings", contains="rationales=None"):
        ensure_export({"micro": store}, tmp_path / "out", images=False)


def test_a_killed_export_resumes_and_gives_the_same_bytes(
    micro_store, exported, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(huggingface, "GROUP_IMAGES", 64)
    monkeypatch.setattr(huggingface, "SHARD_GROUPS", 5)
    folder = tmp_path / "copy" / "micro"
    shutil.copytree(micro_store.folder, folder)
    damaged = Store(folder, micro_store.manifest)
    # The scene is a test scene, so all shards of training items are written before it is read.
    broken = folder / "scenes" / f"{damaged.scene_ids('test')[0]}.npz"
    whole = broken.read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    for frames in (folder / "frames").glob(f"{broken.stem}*"):
        frames.unlink()
    out = tmp_path / "out" / "micro"
    with pytest.raises(Exception, match="not a zip"):
        ensure_export({"micro": damaged}, out, images=True)
    assert not out.exists()
    done = sorted(out.parent.glob(".micro.partial/*/train-*.parquet"))
    assert done
    made = [p.stat().st_mtime_ns for p in done]
    broken.write_bytes(whole)
    ensure_export({"micro": damaged}, out, images=True)
    assert [(out / "/".join(p.parts[-2:])).stat().st_mtime_ns for p in done] == made
    assert {p.name for p in out.parent.iterdir()} == {".micro.lock", "micro"}
    names = sorted(p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(exported).as_posix() for p in exported.rglob("*.*"))
    assert all((out / n).read_bytes() == (exported / n).read_bytes() for n in names)


def test_shards_of_an_export_with_other_settings_are_not_reused(micro_store, tmp_path) -> None:
    out = tmp_path / "out"
    partial = tmp_path / ".out.partial"
    (partial / "selection").mkdir(parents=True)
    (partial / "selection" / "train-00000-of-00001.parquet").write_bytes(b"of another export")
    ensure_export({"micro": micro_store}, out, images=False)
    assert pq.read_metadata(out / "selection" / "train-00000-of-00001.parquet").num_rows == 134


def test_an_existing_export_is_kept_and_other_content_is_refused(micro_store, tmp_path) -> None:
    out = tmp_path / "out"
    first = ensure_export({"micro": micro_store}, out, images=False)
    made = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    assert ensure_export({"micro": micro_store}, out, images=False) == first
    assert made == {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    with raises_user_error("other-settings", contains=("images=False", "images=True")):
        ensure_export({"micro": micro_store}, out, images=True)
    (out / "selection" / "test-00000-of-00001.parquet").write_bytes(b"")
    with raises_user_error("damaged-file", contains="test-00000-of-00001.parquet"):
        ensure_export({"micro": micro_store}, out, images=False)
    (out / "README.md").unlink()
    with raises_user_error("missing-file", contains="README.md"):
        ensure_export({"micro": micro_store}, out, images=False)
    (tmp_path / "notes").mkdir()
    with raises_user_error("folder-in-use"):
        ensure_export({"micro": micro_store}, tmp_path / "notes", images=False)


def test_row_groups_stay_small(exported) -> None:
    for path in exported.rglob("*.parquet"):
        metadata = pq.read_metadata(path)
        assert metadata.num_row_groups <= 5
        rows = [metadata.row_group(k).num_rows for k in range(metadata.num_row_groups)]
        images = {"selection": 16, "matched_anchor": 16, "retrieval": 12 + 1 + 2}
        if path.parent.name != "rationales":
            assert max(rows) <= 64 // images.get(path.parent.name, 1)


def test_the_card_describes_the_export(micro_store, exported) -> None:
    card = DatasetCard.load(exported / "README.md")
    assert card.data.license == "apache-2.0"
    configs = {c["config_name"]: c for c in card.data.configs}
    own = {"database": ["test", "future", "counterfactual"]}
    own |= {"matched_anchor": ["train"], "rationales": ["train"]}
    for name in TABLES:
        splits = [f["split"] for f in configs[name]["data_files"]]
        assert splits == own.get(name, ["train", "test"])
    assert micro_store.identity in card.text
    counts = micro_store.manifest["counts"]
    for family in ("event", "time", "window"):
        train, test = (counts[f"selection/{family}/{split}"] for split in ("train", "test"))
        assert f"| dynapix | {family} | all | {train:,} | {test:,} |" in card.text
    for item in micro_store.selection():
        assert f"| {item.suite} | {item.family} | {item.subtype} |" in card.text


@pytest.mark.parametrize(
    ("simulator", "licence"),
    [("clevrer", "cc0-1.0"), ("movi_a", "other"), ("physion", "other"), ("tracks", "unknown")],
)
def test_the_card_of_a_release_states_its_licence_and_no_local_path(
    micro_store, simulator, licence
) -> None:
    local = {"simulator": simulator, "folder": "/home/somebody/releases"}
    config = micro_store.manifest["config"] | local
    release = replace(micro_store, manifest=micro_store.manifest | {"config": config})
    card = DatasetCard(render_card({"micro": release}, [], images=False))
    assert card.data.license == licence
    assert card.data.source_datasets == ["extended"]
    assert "somebody" not in str(card)
    assert "Scenes are simulated" not in str(card)


def test_the_leaderboard_asks_the_test_items(micro_store, exported) -> None:
    rows = load_dataset(str(exported), "leaderboard", split="test")
    items = micro_store.selection("test")
    assert rows["item_id"] == [item.item_id for item in items]
    assert rows["answer"] == [item.letter for item in items]
    for row, item in zip(rows, items, strict=True):
        assert item.question in row["question"]
    png = base64.b64decode(rows[0]["image"].removeprefix("data:image/png;base64,"))
    sheet, frames = Image.open(io.BytesIO(png)), FrameReader(micro_store)
    target = items[0].candidates[items[0].answer]
    frame = frames.image(target.scene_id, target.frame)
    width = min(frame.width, CELL_WIDTH)
    height = round(frame.height * width / frame.width)
    left = items[0].answer * (width + GAP)
    cell = sheet.crop((left, sheet.height - height, left + width, sheet.height))
    assert np.array_equal(np.asarray(cell), np.asarray(frame.resize((width, height))))
    [task] = yaml.safe_load((exported / EVAL_FILE).read_text())["tasks"]
    assert {*task["field_spec"].values()} <= {*rows.column_names}
    pattern = task["scorers"][0]["args"]["pattern"]
    for text in ("So it is B.\nAnswer: B", "**Answer: B**", "answer: (B)", "Answer: **B**."):
        assert re.findall(pattern, text) == ["B"]
    assert not re.findall(pattern, "Answer: Blue")
