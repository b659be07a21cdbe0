"""An export is the benchmark: what others load from it is what the store holds."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import fields
from pathlib import Path

import numpy as np
import PIL.Image
import pyarrow.parquet as pq
import pytest
from datasets import Image, load_dataset
from huggingface_hub import DatasetCard

from conf.errors import UserError
from data import export as exporter
from data.export import ensure_export
from data.publish.columns import CONFIGURATIONS, MEANING, Rows, features
from data.records import POOLS, RetrievalQuery, SelectionItem, sample_prefix_frames
from data.render.frame_cache import FrameReader
from data.store import Store, hash_file
from data.tracks.controls import MATCHED_ANCHOR

pytestmark = pytest.mark.slow

SPLITS = {
    "selection": ("train", "test"),
    "retrieval": ("train", "test"),
    "database": ("test", "future", "counterfactual"),
}


@pytest.fixture(scope="module")
def exported(micro_store: Store, tmp_path_factory) -> Path:
    """The small benchmark with images, in several files a split."""
    folder = tmp_path_factory.mktemp("exports") / "micro"
    with pytest.MonkeyPatch.context() as small:
        small.setattr(exporter, "GROUP_IMAGES", 64)
        small.setattr(exporter, "SHARD_GROUPS", 5)
        ensure_export(micro_store, folder, True, "https://example.org/dynapix", "2026-01-31")
    return folder


@pytest.fixture(scope="module")
def loaded(exported: Path, tmp_path_factory) -> dict:
    cache = str(tmp_path_factory.mktemp("cache"))
    return {name: load_dataset(str(exported), name, cache_dir=cache) for name in CONFIGURATIONS}


def test_items_and_queries_come_back_as_they_are(micro_store, loaded) -> None:
    for split in ("train", "test"):
        items, queries = loaded["selection"][split], loaded["retrieval"][split]
        kept = [f.name for f in fields(SelectionItem)]
        rows = [SelectionItem.from_row(r) for r in items.select_columns(kept)]
        assert rows == [
            *micro_store.selection(split),
            *micro_store.selection(split, MATCHED_ANCHOR),
        ]
        kept = [f.name for f in fields(RetrievalQuery)]
        rows = [RetrievalQuery.from_row(r) for r in queries.select_columns(kept)]
        assert rows == [q for pool in POOLS for q in micro_store.retrieval(split, pool)]
    for name, frames in loaded["database"].items():
        there = frames.select_columns(["scene_id", "frame"])
        assert [tuple(r.values()) for r in there] == [
            (f.scene_id, f.frame) for f in micro_store.database(name)
        ]


def test_images_are_the_frames_that_the_row_names(micro_store, loaded) -> None:
    frames = FrameReader(micro_store)

    def same(image, scene_id: str, frame: int) -> None:
        assert np.array_equal(np.asarray(image), frames.array(scene_id, frame))

    def some(configuration: str):
        rows = loaded[configuration]["test"]
        return rows.select(range(0, rows.num_rows, 5))

    for row in some("selection"):
        shown = sample_prefix_frames(row["prefix_start"], row["prefix_stop"], 12)
        assert row["shown_frames"] == shown
        for image, frame in zip(row["prefix_images"], shown, strict=True):
            same(image, row["scene_id"], frame)
        for image, candidate in zip(row["candidate_images"], row["candidates"], strict=True):
            same(image, candidate["scene_id"], candidate["frame"])
    for row in some("retrieval"):
        same(row["target_image"], **row["target"])
        same(row["prefix_images"][-1], row["scene_id"], row["prefix_stop"])
    for row in some("database"):
        same(row["image"], row["scene_id"], row["frame"])


def test_a_frame_that_was_not_rendered_ahead_is_drawn(micro_store, tmp_path) -> None:
    (tmp_path / "scenes").symlink_to(micro_store.folder / "scenes")
    rows = Rows(Store(tmp_path, micro_store.manifest), images=True)
    frame = micro_store.database("test")[0]
    drawn = PIL.Image.open(io.BytesIO(rows.row(frame, "test")["image"]["bytes"]))
    assert np.array_equal(drawn, FrameReader(micro_store).array(frame.scene_id, frame.frame))


def test_without_images_a_row_has_the_records_fields(micro_store, tmp_path) -> None:
    told = {name: set(columns) for name, columns in features(images=False).items()}
    assert told["selection"] == {f.name for f in fields(SelectionItem)} | {"shown_frames"}
    assert told["retrieval"] == {f.name for f in fields(RetrievalQuery)} | {"shown_frames"}
    shards = ensure_export(micro_store, tmp_path / "out", images=False)
    assert len(shards) == len({(s.configuration, s.split) for s in shards}) == 7
    assert sum(s.bytes for s in shards) < 200_000
    for shard in shards:
        assert set(pq.read_schema(tmp_path / "out" / shard.path).names) == told[shard.configuration]


def test_every_column_has_a_meaning() -> None:
    assert {c for columns in features(images=True).values() for c in columns} <= set(MEANING)


def test_a_killed_export_leaves_nothing_that_looks_whole_and_goes_on(
    micro_store, exported, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(exporter, "GROUP_IMAGES", 64)
    monkeypatch.setattr(exporter, "SHARD_GROUPS", 5)
    folder = tmp_path / "copy" / "micro"
    shutil.copytree(micro_store.folder, folder)
    hurt = Store(folder, micro_store.manifest)
    # A test scene: every shard of the training items is written by then.
    broken = folder / "scenes" / f"{hurt.scene_ids('test')[0]}.npz"
    whole = broken.read_bytes()
    broken.write_bytes(whole[: len(whole) // 2])
    shutil.rmtree(folder / "frames")
    out = tmp_path / "out" / "micro"
    arguments = (out, True, "https://example.org/dynapix", "2026-01-31")
    with pytest.raises(Exception, match="not a zip"):
        ensure_export(hurt, *arguments)
    assert not out.exists()
    done = sorted(out.parent.glob(".micro.partial/*/train-*.parquet"))
    assert done
    made = [p.stat().st_mtime_ns for p in done]
    broken.write_bytes(whole)
    ensure_export(hurt, *arguments)
    assert [(out / p.relative_to(p.parents[1])).stat().st_mtime_ns for p in done] == made
    assert [p.name for p in out.parent.iterdir()] == ["micro"]
    # Bytes tell neither of the kill nor of the time.
    names = sorted(p.relative_to(out).as_posix() for p in out.rglob("*") if p.is_file())
    assert names == sorted(p.relative_to(exported).as_posix() for p in exported.rglob("*.*"))
    assert all((out / n).read_bytes() == (exported / n).read_bytes() for n in names)


def test_what_a_killed_export_of_other_settings_left_is_not_taken(micro_store, tmp_path) -> None:
    out = tmp_path / "out"
    partial = tmp_path / ".out.partial"
    (partial / "selection").mkdir(parents=True)
    (partial / "selection" / "train-00000-of-00001.parquet").write_bytes(b"of another export")
    ensure_export(micro_store, out, images=False)
    assert pq.read_metadata(out / "selection" / "train-00000-of-00001.parquet").num_rows == 126 + 4


def test_the_same_export_is_left_as_it_is(micro_store, tmp_path) -> None:
    out = tmp_path / "out"
    first = ensure_export(micro_store, out, images=False)
    made = {p: p.stat().st_mtime_ns for p in out.rglob("*")}
    assert ensure_export(micro_store, out, images=False) == first
    assert made == {p: p.stat().st_mtime_ns for p in out.rglob("*")}


def test_anything_else_at_the_folder_is_a_sentence(micro_store, tmp_path) -> None:
    out = tmp_path / "out"
    ensure_export(micro_store, out, images=False)
    with pytest.raises(UserError, match="its images is False, that of the one you ask for is True"):
        ensure_export(micro_store, out, images=True)
    (out / "selection" / "test-00000-of-00001.parquet").write_bytes(b"")
    with pytest.raises(UserError, match=r"test-00000-of-00001\.parquet is damaged: delete"):
        ensure_export(micro_store, out, images=False)
    (out / "README.md").unlink()
    with pytest.raises(UserError, match=r"README\.md is missing: delete"):
        ensure_export(micro_store, out, images=False)
    (tmp_path / "notes").mkdir()
    with pytest.raises(UserError, match="holds no export that can be read: choose another folder"):
        ensure_export(micro_store, tmp_path / "notes", images=False)


def test_row_groups_stay_small(exported) -> None:
    for path in exported.rglob("*.parquet"):
        told = pq.read_metadata(path)
        assert told.num_row_groups <= 5
        rows = [told.row_group(k).num_rows for k in range(told.num_row_groups)]
        assert max(rows) <= 64 // {"selection": 16, "retrieval": 13}.get(path.parent.name, 1)


def test_the_card_tells_what_is_there(micro_store, exported, loaded) -> None:
    card = DatasetCard.load(exported / "README.md")
    assert (card.data.license, card.data.size_categories) == ("apache-2.0", "n<1K")
    told = {c["config_name"]: c for c in card.data.configs}
    infos = {i["config_name"]: i for i in card.data.dataset_info}
    for name, splits in SPLITS.items():
        assert [f["split"] for f in told[name]["data_files"]] == list(splits)
        for split in infos[name]["splits"]:
            assert split["num_examples"] == loaded[name][split["name"]].num_rows
    assert micro_store.identity in card.text
    counts = micro_store.manifest["counts"]
    for family in ("event", "time", "window"):
        train, test = (counts[f"selection/{family}/{split}"] for split in ("train", "test"))
        assert f"| {family} | all | {train:,} | {test:,} |" in card.text
    for item in micro_store.selection():
        assert f"| {item.family} | {item.subtype} |" in card.text


def test_croissant_keeps_to_its_vocabulary(micro_store, exported) -> None:
    told = json.loads((exported / "croissant.json").read_text())
    required = {"@context", "@type", "conformsTo", "description", "license", "name", "url"}
    assert required | {"creator", "datePublished", "distribution", "recordSet"} <= set(told)
    used = set(_keys({k: v for k, v in told.items() if k != "@context"}))
    schema_org = {
        "name", "description", "license", "url", "creator", "datePublished", "version",
        "keywords", "inLanguage", "distribution", "contentUrl", "contentSize", "encodingFormat",
        "sha256",
    }  # fmt: skip
    assert {k for k in used if k[0] != "@"} <= schema_org | set(told["@context"])
    files = [d for d in told["distribution"] if d["@type"] == "cr:FileObject"]
    sets = {d["@id"]: d for d in told["distribution"] if d["@type"] == "cr:FileSet"}
    on_disk = {p.relative_to(exported).as_posix(): p for p in exported.rglob("*.parquet")}
    assert {f["contentUrl"]: f["sha256"] for f in files} == {
        name: hash_file(path) for name, path in on_disk.items()
    }
    ids = [*_ids(told["distribution"]), *_ids(told["recordSet"])]
    assert len(ids) == len(set(ids))
    for records in told["recordSet"]:
        [pattern] = [s["includes"] for s in sets.values() if s["@id"] == f"{records['@id']}-files"]
        one = next(p for name, p in on_disk.items() if Path(name).match(pattern))
        schema = pq.read_schema(one)
        assert [f["name"] for f in records["field"]] == schema.names
        assert {k["@id"] for k in records["key"]} <= set(_ids(records["field"]))
        for leaf in _leaves(records["field"]):
            assert leaf["dataType"] in {
                "sc:Text", "sc:Integer", "sc:Float", "sc:Boolean", "sc:ImageObject"
            }  # fmt: skip
            assert leaf["source"]["fileSet"]["@id"] in sets
            assert leaf["source"]["extract"]["column"] in schema.names
    leaves = [leaf for records in told["recordSet"] for leaf in _leaves(records["field"])]
    images = {leaf["@id"] for leaf in leaves if leaf["dataType"] == "sc:ImageObject"}
    kinds = features(images=True)
    expected = {
        f"{name}/{column}" for name, columns in kinds.items()
        for column, kind in columns.items() if isinstance(getattr(kind, "feature", kind), Image)
    }  # fmt: skip
    assert images == expected


def _keys(value):
    if isinstance(value, dict):
        yield from value
        for inner in value.values():
            yield from _keys(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from _keys(inner)


def _ids(nodes):
    """Ids that are given to something; one that stands alone refers to it."""
    for node in nodes:
        yield node["@id"]
        yield from _ids([*node.get("field", ()), *node.get("subField", ())])


def _leaves(fields):
    for field in fields:
        if "subField" in field:
            yield from _leaves(field["subField"])
        else:
            yield field
