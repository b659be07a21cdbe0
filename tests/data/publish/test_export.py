"""`datasets` loads from an export the same records and frames that the store contains."""

from __future__ import annotations

import re
import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from datasets import load_dataset
from huggingface_hub import DatasetCard

from conf.schema.benchmark import MATCHED_ANCHOR, POOLS
from data.frames.frame_cache import FrameReader
from data.publish import huggingface
from data.publish.columns import COLUMNS, DESCRIPTIONS, dataset_features
from data.publish.huggingface import ensure_export, render_card
from data.records import SPLITS, RetrievalQuery, SelectionItem, sample_prefix_frames
from data.store import Store
from tests.user_errors import raises_user_error

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def exported(micro_store: Store, tmp_path_factory) -> Path:
    """An export of the small benchmark with images, in several files per split."""
    folder = tmp_path_factory.mktemp("exports") / "micro"
    with pytest.MonkeyPatch.context() as small:
        small.setattr(huggingface, "GROUP_IMAGES", 64)
        small.setattr(huggingface, "SHARD_GROUPS", 5)
        ensure_export(micro_store, folder, images=True)
    return folder


@pytest.fixture(scope="module")
def loaded(exported: Path, tmp_path_factory) -> dict:
    cache = str(tmp_path_factory.mktemp("cache"))
    return {name: load_dataset(str(exported), name, cache_dir=cache) for name in COLUMNS}


def test_loaded_records_equal_the_stores_records(micro_store, loaded) -> None:
    for split in ("train", "test"):
        items, queries = loaded["selection"][split], loaded["retrieval"][split]
        kept = [f.name for f in fields(SelectionItem)]
        rows = [SelectionItem.from_row(r) for r in items.select_columns(kept)]
        matched = micro_store.selection(split, MATCHED_ANCHOR)
        assert rows == micro_store.selection(split) + matched
        kept = [f.name for f in fields(RetrievalQuery)]
        rows = [RetrievalQuery.from_row(r) for r in queries.select_columns(kept)]
        assert rows == [q for pool in POOLS for q in micro_store.retrieval(split, pool)]
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
        loaded[name]["test"].select(range(0, loaded[name]["test"].num_rows, 5)) for name in COLUMNS
    )
    for row in selection:
        frames_of_prefix = sample_prefix_frames(row["prefix_start"], row["prefix_stop"], 12)
        assert row["prefix_frames"] == frames_of_prefix
        for image, frame in zip(row["prefix_images"], frames_of_prefix, strict=True):
            same(image, row["scene_id"], frame)
        for image, candidate in zip(row["candidate_images"], row["candidates"], strict=True):
            same(image, candidate["scene_id"], candidate["frame"])
    for row in retrieval:
        same(row["target_image"], **row["target"])
        same(row["prefix_images"][-1], row["scene_id"], row["prefix_stop"])
    for row in database:
        same(row["image"], row["scene_id"], row["frame"])


def test_without_images_the_columns_are_the_records_fields(micro_store, tmp_path) -> None:
    columns = {name: set(kinds) for name, kinds in dataset_features(images=False).items()}
    assert columns["selection"] == {f.name for f in fields(SelectionItem)} | {"prefix_frames"}
    assert columns["retrieval"] == {f.name for f in fields(RetrievalQuery)} | {"prefix_frames"}
    shards = ensure_export(micro_store, tmp_path / "out", images=False)
    assert len(shards) == len({(s["configuration"], s["split"]) for s in shards}) == 7
    assert sum(s["bytes"] for s in shards) < 200_000
    for shard in shards:
        schema = pq.read_schema(tmp_path / "out" / shard["path"])
        assert set(schema.names) == columns[shard["configuration"]] <= set(DESCRIPTIONS)


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
        ensure_export(damaged, out, images=True)
    assert not out.exists()
    done = sorted(out.parent.glob(".micro.partial/*/train-*.parquet"))
    assert done
    made = [p.stat().st_mtime_ns for p in done]
    broken.write_bytes(whole)
    ensure_export(damaged, out, images=True)
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
    ensure_export(micro_store, out, images=False)
    assert pq.read_metadata(out / "selection" / "train-00000-of-00001.parquet").num_rows == 134 + 4


def test_an_existing_export_is_kept_and_other_content_is_refused(micro_store, tmp_path) -> None:
    out = tmp_path / "out"
    first = ensure_export(micro_store, out, images=False)
    made = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    assert ensure_export(micro_store, out, images=False) == first
    assert made == {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    with raises_user_error("other-settings", contains=("images=False", "images=True")):
        ensure_export(micro_store, out, images=True)
    (out / "selection" / "test-00000-of-00001.parquet").write_bytes(b"")
    with raises_user_error("damaged-file", contains="test-00000-of-00001.parquet"):
        ensure_export(micro_store, out, images=False)
    (out / "README.md").unlink()
    with raises_user_error("missing-file", contains="README.md"):
        ensure_export(micro_store, out, images=False)
    (tmp_path / "notes").mkdir()
    with raises_user_error("folder-in-use"):
        ensure_export(micro_store, tmp_path / "notes", images=False)


def test_row_groups_stay_small(exported) -> None:
    for path in exported.rglob("*.parquet"):
        metadata = pq.read_metadata(path)
        assert metadata.num_row_groups <= 5
        rows = [metadata.row_group(k).num_rows for k in range(metadata.num_row_groups)]
        assert max(rows) <= 64 // {"selection": 16, "retrieval": 13}.get(path.parent.name, 1)


def test_the_card_describes_the_export(micro_store, exported) -> None:
    card = DatasetCard.load(exported / "README.md")
    assert card.data.license == "apache-2.0"
    configs = {c["config_name"]: c for c in card.data.configs}
    databases = ["test", "future", "counterfactual"]
    for name, splits in zip(COLUMNS, [["train", "test"]] * 2 + [databases], strict=True):
        assert [f["split"] for f in configs[name]["data_files"]] == splits
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
    card = DatasetCard(render_card(release, [], images=False))
    assert card.data.license == licence
    assert card.data.source_datasets == ["extended"]
    assert "somebody" not in str(card)
    assert "Scenes are simulated" not in str(card)


def test_the_card_counts_the_rows_of_every_suite(exported, loaded) -> None:
    text = (exported / "README.md").read_text()
    family = r"^\| (?:dynapix|matched_anchor) \| \w+ \| all \| (\d+) \| (\d+) \|$"
    counted = re.findall(family, text, re.MULTILINE)
    rows = {split: len(loaded["selection"][split]) for split in SPLITS}
    assert sum(int(train) for train, _ in counted) == rows["train"]
    assert sum(int(test) for _, test in counted) == rows["test"]
