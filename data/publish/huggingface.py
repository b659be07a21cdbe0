"""Write a benchmark as a Hugging Face dataset, which loads without this code.

    <folder>/README.md      the dataset card, which names the files of each split
             export.json    what was exported, with the SHA-256 of every file
             selection/ retrieval/ database/    <split>-00000-of-00002.parquet

The dataset is written to a hidden folder beside `<folder>`, one shard after another, and renamed
when it is complete. A killed export resumes with the shards that it has written.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from conf.errors import UserError
from conf.runs import lock_folder
from data.publish.columns import RowBuilder, dataset_features
from data.publish.dataset_card import render_card
from data.records import POOLS, SPLITS, FrameRef, RetrievalQuery, SelectionItem
from data.store import DATABASES, Store, hash_file, write_atomically
from data.tracks.controls import MATCHED_ANCHOR

if TYPE_CHECKING:
    import pyarrow as pa

log = logging.getLogger(__name__)

RECORD, CARD = "export.json", "README.md"
EXPORT_VERSION = "2"
"""Changes whenever the same store would give another dataset."""
GROUP_IMAGES = 512
"""Images of a parquet row group, about 30 MB at 480 x 320 px; an export holds one in memory."""
GROUP_ROWS = 5_000
"""Rows of a row group without images."""
SHARD_GROUPS = 10
"""Row groups of a shard."""


@dataclass(frozen=True)
class Table:
    """A split of a configuration, or a database: its records in the store's order."""

    configuration: str
    split: str
    records: Sequence[SelectionItem | RetrievalQuery | FrameRef]


@dataclass(frozen=True)
class Shard:
    """A written file: its path relative to the export's folder, and its sizes on disk and in
    memory."""

    configuration: str
    split: str
    path: str
    rows: int
    bytes: int
    uncompressed: int
    sha256: str


def ensure_export(store: Store, folder: Path, images: bool) -> list[Shard]:
    """Return the shards of the export of `store` at `folder`, which is written if missing.

    Raises:
        UserError: `folder` holds something else, or that export is damaged.
    """
    plan = {
        "benchmark": store.name,
        "identity": store.identity,
        "version": EXPORT_VERSION,
        "images": images,
    }
    if folder.exists():
        _verify(folder, plan)
        log.info("%s already holds this export", folder)
    else:
        write_export(store, folder, plan)
    return [Shard(**shard) for shard in _read_record(folder)["shards"]]


def write_export(store: Store, folder: Path, plan: dict[str, Any]) -> None:
    """Write the dataset that `plan` describes, resuming what a killed export left."""
    partial = folder.with_name(f".{folder.name}.partial")
    partial.mkdir(parents=True, exist_ok=True)
    busy = f"another process is writing {folder}: run this command again when it has finished"
    with lock_folder(partial, busy):
        if _differences(_read_record(partial), plan):
            for path in partial.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        _write_record(partial, plan)
        columns = dataset_features(plan["images"])
        builder = RowBuilder(store, plan["images"])
        tables = list_tables(store)
        rows = sum(len(table.records) for table in tables)
        with tqdm(total=rows, desc="exporting", unit="row", mininterval=1.0) as bar:
            shards = [
                shard
                for table in tables
                for shard in _write_table(
                    partial, table, builder, columns[table.configuration].arrow_schema, bar
                )
            ]
        card = render_card(store, columns, shards, plan["images"])
        write_atomically(partial / CARD, card.encode())
        written = {"shards": [vars(s) for s in shards], "card": hash_file(partial / CARD)}
        _write_record(partial, plan | written)
        partial.rename(folder)


def list_tables(store: Store) -> list[Table]:
    """Return every split of every track and every database that is not empty."""
    items = {
        split: [*store.selection(split), *store.selection(split, MATCHED_ANCHOR)]
        for split in SPLITS
    }
    queries = {
        split: [q for pool in POOLS for q in store.retrieval(split, pool)] for split in SPLITS
    }
    databases = {name: store.database(name) for name in DATABASES}
    tracks = {"selection": items, "retrieval": queries, "database": databases}
    return [
        Table(configuration, split, records)
        for configuration, splits in tracks.items()
        for split, records in splits.items()
        if records
    ]


def _write_table(
    folder: Path, table: Table, builder: RowBuilder, schema: pa.Schema, bar: tqdm
) -> Iterator[Shard]:
    """Write the shards of a table that do not exist yet, and describe all of them."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    images = builder.images_per_row(table.configuration)
    group = max(1, GROUP_IMAGES // images) if images else GROUP_ROWS
    size = group * SHARD_GROUPS
    count = -(-len(table.records) // size)
    for k in range(count):
        name = f"{table.configuration}/{table.split}-{k:05d}-of-{count:05d}.parquet"
        path = folder / name
        records = table.records[k * size : (k + 1) * size]
        if path.exists():
            bar.update(len(records))
        else:
            path.parent.mkdir(exist_ok=True)
            unfinished = path.with_name(f".{path.name}.partial")
            with pq.ParquetWriter(unfinished, schema, compression="zstd") as writer:
                for start in range(0, len(records), group):
                    rows = [builder.row(r, table.split) for r in records[start : start + group]]
                    writer.write_table(pa.Table.from_pylist(rows, schema))
                    bar.update(len(rows))
            os.replace(unfinished, path)
        metadata = pq.read_metadata(path)
        groups = map(metadata.row_group, range(metadata.num_row_groups))
        yield Shard(
            table.configuration,
            table.split,
            path=name,
            rows=metadata.num_rows,
            bytes=path.stat().st_size,
            uncompressed=sum(g.total_byte_size for g in groups),
            sha256=hash_file(path),
        )


def _write_record(folder: Path, record: dict[str, Any]) -> None:
    write_atomically(folder / RECORD, json.dumps(record, indent=1).encode())


def _read_record(folder: Path) -> dict[str, Any]:
    """The content of export.json, empty if it is missing or cannot be read."""
    try:
        record = json.loads((folder / RECORD).read_text())
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def _differences(record: dict[str, Any], plan: dict[str, Any]) -> list[str]:
    return [key for key in plan if record.get(key) != plan[key]]


def _verify(folder: Path, plan: dict[str, Any]) -> None:
    record = _read_record(folder)
    if "shards" not in record:
        raise UserError(
            f"{folder} exists and holds no readable export: choose another folder with "
            "folder=FOLDER",
            code="folder-in-use",
        )
    for key in _differences(record, plan):
        raise UserError(
            f"{folder} holds an export with {key}={record.get(key)}, not {key}={plan[key]}: choose "
            f"another folder with folder=FOLDER, or delete {folder}",
            code="different-settings",
        )
    expected = {CARD: record["card"]} | {s["path"]: s["sha256"] for s in record["shards"]}
    for name, sha256 in expected.items():
        path = folder / name
        if not path.exists():
            raise UserError(
                f"{path} is missing: delete {folder} and export again", code="missing-file"
            )
        if hash_file(path) != sha256:
            raise UserError(
                f"{path} is damaged: delete {folder} and export again", code="damaged-file"
            )


def summarize(folder: Path, shards: Sequence[Shard]) -> str:
    """Return the rows, size and number of files of each split as a table."""
    lines = [f"{folder} ({sum(s.bytes for s in shards) / 1e6:,.1f} MB)"]
    lines.append(f"  {'split':<28}{'rows':>8}{'MB':>10}{'files':>8}")
    for name in dict.fromkeys((s.configuration, s.split) for s in shards):
        files = [s for s in shards if (s.configuration, s.split) == name]
        rows, size = sum(s.rows for s in files), sum(s.bytes for s in files) / 1e6
        lines.append(f"  {'/'.join(name):<28}{rows:>8,}{size:>10,.1f}{len(files):>8}")
    return "\n".join(lines)
