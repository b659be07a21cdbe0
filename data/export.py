"""Write a benchmark as others read it: as a Hugging Face dataset, which loads without this code, or
its scenes as CLEVRER's release has them (see `data.publish.clevrer_format`).

    exports/<name>/huggingface/
        README.md        the dataset card, by which `datasets.load_dataset` finds what is where
        croissant.json   the same for other tools
        export.json      what was exported, and a SHA-256 for every file
        selection/ retrieval/ database/    <split>-00000-of-00002.parquet

The dataset is written in a folder beside it, one shard after another, and renamed when it is whole,
so that a killed export goes on with the shards it has.
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

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import lock_folder, write_text
from conf.schema import ExportCommand
from data.parallel import Workers
from data.publish.columns import Rows, features
from data.records import POOLS, SPLITS, FrameRef, RetrievalQuery, SelectionItem
from data.store import DATABASES, Store, add_checksum, hash_file, write_atomically
from data.tracks.controls import MATCHED_ANCHOR

if TYPE_CHECKING:
    import pyarrow as pa

log = logging.getLogger(__name__)

RECORD = "export.json"
EXPORT_VERSION = "1"
"""Changes whenever the same store would give another dataset."""
GROUP_IMAGES = 512
"""Images of a parquet row group, about 30 MB at 480 x 320 px: what an export holds in memory."""
GROUP_ROWS = 5_000
"""Rows of a row group without images."""
SHARD_GROUPS = 10
"""Row groups of a file."""


@dataclass(frozen=True)
class Part:
    """A split of a configuration, or a database: its records in the store's order."""

    configuration: str
    split: str
    records: Sequence[SelectionItem | RetrievalQuery | FrameRef]


@dataclass(frozen=True)
class Shard:
    """A written file, its path relative to the export's folder, and both of its sizes."""

    configuration: str
    split: str
    path: str
    rows: int
    bytes: int
    uncompressed: int
    sha256: str


@command("data.export", ExportCommand)
def main(cfg: ExportCommand, run: Run) -> dict[str, float]:
    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    if cfg.format == "clevrer":
        from data.publish.clevrer_format import export_clevrer

        scenes = export_clevrer(store, Path(cfg.folder), Workers(cfg.workers))
        log.info("%s holds %d scenes as CLEVRER's release has them", cfg.folder, scenes)
        return {"scenes": float(scenes)}
    shards = ensure_export(store, Path(cfg.folder), cfg.images, cfg.url, cfg.published)
    text = summary(Path(cfg.folder), shards)
    log.info("%s", text)
    write_text(run.folder / "report.txt", text + "\n")
    rows = {f"rows/{s.configuration}/{s.split}": 0.0 for s in shards}
    for shard in shards:
        rows[f"rows/{shard.configuration}/{shard.split}"] += shard.rows
    return rows | {"bytes": float(sum(s.bytes for s in shards))}


def ensure_export(
    store: Store,
    folder: Path,
    images: bool,
    url: str | None = None,
    published: str | None = None,
) -> list[Shard]:
    """The export of `store` at `folder`, written where it is missing.

    Raises:
        UserError: something else is there, or that export is damaged.
    """
    plan = {
        "benchmark": store.name,
        "identity": store.identity,
        "version": EXPORT_VERSION,
        "images": images,
        "url": url,
        "published": published,
    }
    if folder.exists():
        _check_there(folder, plan)
        log.info("%s holds this export already", folder)
    else:
        export(store, folder, plan)
    return [Shard(**shard) for shard in _record(folder)["shards"]]


def export(store: Store, folder: Path, plan: dict[str, Any]) -> None:
    """Write the dataset that `plan` describes, going on with what a killed export left."""
    from data.publish import croissant, dataset_card

    growing = folder.with_name(f".{folder.name}.partial")
    growing.mkdir(parents=True, exist_ok=True)
    busy = f"{folder} is being written by another process; run this again when it is done"
    with lock_folder(growing, busy):
        _begin(growing, plan)
        columns = features(plan["images"])
        rows = Rows(store, plan["images"])
        every = parts(store)
        shards: list[Shard] = []
        total = sum(len(part.records) for part in every)
        with tqdm(total=total, desc="exporting", unit="row", mininterval=1.0) as bar:
            for part in every:
                schema = columns[part.configuration].arrow_schema
                shards += _write_part(growing, part, rows, schema, plan["images"], bar)
        described = {
            "README.md": dataset_card.text(store, columns, shards, plan),
            "croissant.json": croissant.text(store, columns, shards, plan),
        }
        for name, text in described.items():
            write_atomically(growing / name, text.encode())
        record = plan | {
            "shards": [vars(s) for s in shards],
            "described": {name: hash_file(growing / name) for name in described},
        }
        write_atomically(growing / RECORD, json.dumps(add_checksum(record), indent=1).encode())
        growing.rename(folder)


def parts(store: Store) -> list[Part]:
    """What an export holds: every split of every track and every database that is not empty."""
    items = {
        split: [*store.selection(split), *store.selection(split, MATCHED_ANCHOR)]
        for split in SPLITS
    }
    queries = {
        split: [q for pool in POOLS for q in store.retrieval(split, pool)] for split in SPLITS
    }
    databases = {name: store.database(name) for name in DATABASES}
    found = {"selection": items, "retrieval": queries, "database": databases}
    return [
        Part(configuration, split, records)
        for configuration, splits in found.items()
        for split, records in splits.items()
        if records
    ]


def _write_part(
    growing: Path, part: Part, rows: Rows, schema: pa.Schema, images: bool, bar: tqdm
) -> Iterator[Shard]:
    group = max(1, GROUP_IMAGES // rows.images_of(part.configuration)) if images else GROUP_ROWS
    size = group * SHARD_GROUPS
    count = -(-len(part.records) // size)
    for k in range(count):
        name = f"{part.configuration}/{part.split}-{k:05d}-of-{count:05d}.parquet"
        records = part.records[k * size : (k + 1) * size]
        if (growing / name).exists():
            bar.update(len(records))
        else:
            tables = (records[start : start + group] for start in range(0, len(records), group))
            _write_shard(growing / name, tables, part.split, rows, schema, bar)
        yield _shard(growing, name, part)


def _write_shard(
    path: Path,
    groups: Iterator[Sequence[Any]],
    split: str,
    rows: Rows,
    schema: pa.Schema,
    bar: tqdm,
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    path.parent.mkdir(exist_ok=True)
    partial = path.with_name(f".{path.name}.partial")
    with pq.ParquetWriter(partial, schema, compression="zstd") as writer:
        for group in groups:
            table = [rows.row(record, split) for record in group]
            writer.write_table(pa.Table.from_pylist(table, schema))
            bar.update(len(group))
    os.replace(partial, path)


def _shard(growing: Path, name: str, part: Part) -> Shard:
    import pyarrow.parquet as pq

    path = growing / name
    told = pq.read_metadata(path)
    return Shard(
        configuration=part.configuration,
        split=part.split,
        path=name,
        rows=told.num_rows,
        bytes=path.stat().st_size,
        uncompressed=sum(told.row_group(k).total_byte_size for k in range(told.num_row_groups)),
        sha256=hash_file(path),
    )


def _begin(growing: Path, plan: dict[str, Any]) -> None:
    """Keep what an export of the same plan left, and nothing else."""
    there = _record(growing)
    if there is None or _differing(there, plan):
        for path in growing.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    write_atomically(growing / RECORD, json.dumps(add_checksum(plan)).encode())


def _record(folder: Path) -> dict[str, Any] | None:
    """What an export's folder says of itself; None where it says nothing that can be relied on."""
    try:
        record = json.loads((folder / RECORD).read_text())
        return record if record == add_checksum(record) else None
    except (OSError, ValueError, AttributeError):
        return None


def _differing(there: dict[str, Any], plan: dict[str, Any]) -> list[str]:
    return [key for key in plan if there.get(key) != plan[key]]


def _check_there(folder: Path, plan: dict[str, Any]) -> None:
    there = _record(folder)
    if there is None or "shards" not in there:
        raise UserError(
            f"{folder} is there and holds no export that can be read: choose another folder with "
            "folder=FOLDER"
        )
    if differing := _differing(there, plan):
        key = differing[0]
        raise UserError(
            f"{folder} holds another export: its {key} is {there.get(key)}, that of the one you "
            f"ask for is {plan[key]}; choose another folder with folder=FOLDER, or delete {folder}"
        )
    expected = there["described"] | {s["path"]: s["sha256"] for s in there["shards"]}
    for name, sha256 in expected.items():
        path = folder / name
        if not path.exists() or hash_file(path) != sha256:
            what = "damaged" if path.exists() else "missing"
            raise UserError(f"{path} is {what}: delete {folder} and export it again")


def summary(folder: Path, shards: list[Shard]) -> str:
    """What an export holds, as a small table."""
    lines = [f"{folder} ({sum(s.bytes for s in shards) / 1e6:,.1f} MB)"]
    for name in dict.fromkeys(f"{s.configuration}/{s.split}" for s in shards):
        mine = [s for s in shards if f"{s.configuration}/{s.split}" == name]
        files = f"{len(mine)} file{'s' if len(mine) > 1 else ''}"
        size = sum(s.bytes for s in mine) / 1e6
        lines.append(f"  {name:<28}{sum(s.rows for s in mine):>8,} rows{size:>12,.1f} MB  {files}")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
