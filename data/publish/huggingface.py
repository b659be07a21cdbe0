"""Write a benchmark as a Hugging Face dataset, which can be loaded without this repository.

    <folder>/README.md      the dataset card, which names the files of each split
             export.json    the exported benchmark's identity, and the SHA-256 of every file
             selection/ retrieval/ database/    <split>-00000-of-00002.parquet

The dataset is written to a hidden folder beside `<folder>`, one shard after another, and renamed
when it is complete. A killed export resumes with the shards that it has written.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf
from tqdm import tqdm

from conf.errors import UserError
from conf.files import read_json_if_valid, write_bytes
from conf.runs import lock_file
from conf.schema.benchmark import PAIRED, POOLS
from data.publish.columns import (
    DESCRIPTIONS,
    ExportedRecord,
    RowBuilder,
    dataset_features,
    list_columns,
)
from data.records import SPLITS, RetrievalQuery, SelectionItem
from data.store import DATABASES, Store, hash_file
from data.versions import component_versions

if TYPE_CHECKING:
    import pandas as pd

log = logging.getLogger(__name__)

EXPORT_RECORD, CARD = "export.json", "README.md"
EXPORT_VERSION = "4"
"""Changes whenever the same store would give another dataset."""
GROUP_IMAGES = 512
"""Images in a parquet row group (about 30 MB at 480 x 320 px), which an export keeps in memory."""
GROUP_ROWS = 5_000
"""Number of rows in a row group without images."""
SHARD_GROUPS = 10
"""Number of row groups in a shard."""
ORIGINS: dict[str, dict[str, str]] = {
    "bullet": {"license": "apache-2.0"},
    "clevrer": {
        "license": "cc0-1.0", "terms": "CC0 1.0",
        "title": "CLEVRER", "link": "http://clevrer.csail.mit.edu",
    },
    "movi_a": {
        "license": "other", "name": "kubric-movi-a", "terms": "see the link", "title": "MOVi-A",
        "link": "https://github.com/google-research/kubric/tree/main/challenges/movi",
    },
    "physion": {
        "license": "other", "name": "physion", "terms": "see the link", "title": "Physion",
        "link": "https://github.com/cogtoolslab/physics-benchmarking-neurips2021",
    },
    "tracks": {
        "license": "unknown", "terms": "ask the builder",
        "title": "videos that the builder of this benchmark supplied",
    },
}  # fmt: skip
"""Licence and source of the scenes by simulator, as the card states them."""
Shard = dict[str, Any]
"""Entry of a parquet file in export.json: configuration, split, path relative to the export's
folder, rows, bytes and sha256."""


def ensure_export(store: Store, folder: Path, images: bool) -> list[Shard]:
    """Export a store to `folder` unless that is already done, and return the shards.

    Raises:
        UserError: `folder` contains something else or a damaged export, or another process is
            writing to it.
    """
    plan = {
        "benchmark": store.name,
        "identity": store.identity,
        "version": EXPORT_VERSION,
        "images": images,
    }
    if folder.exists():
        shards = _verify(folder, plan)
        log.info("%s already holds this export", folder)
        return shards
    partial = folder.with_name(f".{folder.name}.partial")
    busy = f"another process is writing {folder}: run this command again when it has finished"
    with lock_file(partial.with_suffix(".lock"), busy):
        partial.mkdir(exist_ok=True)
        if not plan.items() <= read_json_if_valid(partial / EXPORT_RECORD).items():
            for path in partial.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        _write_record(partial, plan)
        builder, tables, shards = RowBuilder(store, images), list_tables(store), []
        rows = sum(map(len, tables.values()))
        with tqdm(total=rows, desc="exporting", unit="row", mininterval=1.0) as bar:
            for (configuration, split), records in tables.items():
                shards += _write_table(partial, configuration, split, records, builder, bar)
        write_bytes(partial / CARD, render_card(store, shards, images).encode())
        _write_record(partial, plan | {"shards": shards, "card": hash_file(partial / CARD)})
        partial.rename(folder)
    return shards


def list_tables(store: Store) -> dict[tuple[str, str], list[ExportedRecord]]:
    """Return the records of each table that is not empty, by configuration and split. The splits
    of the configuration `database` are the databases."""
    tables: dict[tuple[str, str], list[ExportedRecord]] = {}
    for split in SPLITS:
        tables["selection", split] = [
            item for suite in (None, *PAIRED) for item in store.selection(split, suite)
        ]
    for split in SPLITS:
        tables["retrieval", split] = [q for pool in POOLS for q in store.retrieval(split, pool)]
    tables |= {("database", name): store.database(name) for name in DATABASES}
    return {name: records for name, records in tables.items() if records}


def _write_table(
    folder: Path,
    configuration: str,
    split: str,
    records: list[ExportedRecord],
    builder: RowBuilder,
    bar: tqdm,
) -> Iterator[Shard]:
    """Write the missing shards of a table, and yield each of its shards."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = dataset_features(builder.images)[configuration].arrow_schema
    images = builder.images_per_row(configuration)
    group = max(1, GROUP_IMAGES // images) if images else GROUP_ROWS
    size = group * SHARD_GROUPS
    count = -(-len(records) // size)
    for k in range(count):
        path = folder / configuration / f"{split}-{k:05d}-of-{count:05d}.parquet"
        part = records[k * size : (k + 1) * size]
        if path.exists():
            bar.update(len(part))
        else:
            path.parent.mkdir(exist_ok=True)
            unfinished = path.with_name(f".{path.name}.partial")
            with (
                open(unfinished, "wb") as file,
                pq.ParquetWriter(file, schema, compression="zstd") as writer,
            ):
                for start in range(0, len(part), group):
                    rows = [builder.row(r, split) for r in part[start : start + group]]
                    writer.write_table(pa.Table.from_pylist(rows, schema))
                    bar.update(len(rows))
            os.replace(unfinished, path)
        yield {
            "configuration": configuration,
            "split": split,
            "path": path.relative_to(folder).as_posix(),
            "rows": len(part),
            "bytes": path.stat().st_size,
            "sha256": hash_file(path),
        }


def render_card(store: Store, shards: Sequence[Shard], images: bool) -> str:
    """Return the dataset card (README.md) of an export with these shards."""
    from jinja2 import Template

    # The folder of a release is that of the machine on which the benchmark was built.
    settings = store.manifest["config"] | {"folder": None}
    rows: dict[str, Counter[str]] = {}
    for shard in shards:
        rows.setdefault(shard["configuration"], Counter())[shard["split"]] += shard["rows"]
    items = [i for suite in (None, *PAIRED) for i in store.selection(suite=suite)]
    queries = [q for pool in POOLS for q in store.retrieval(pool=pool)]
    text = (files("data.publish") / "templates/dataset_card.md").read_text()
    return Template(text).render(
        store=store,
        images=images,
        scene=store.scene(store.scene_ids("test")[0]),
        scenes={split: len(store.scene_ids(split)) for split in SPLITS},
        origin=ORIGINS[settings["simulator"]],
        is_simulated=settings["simulator"] == "bullet",
        families=_count_rows(items, "suite", "family"),
        subtypes=_count_rows(items, "suite", "family", "subtype"),
        queries=_count_rows(queries, "pool", "builder", "anchor"),
        rows=rows,
        columns=list_columns(images),
        descriptions=DESCRIPTIONS,
        versions=component_versions(settings),
        settings=OmegaConf.to_yaml(OmegaConf.create(settings)),
    )


def _count_rows(records: Iterable[SelectionItem | RetrievalQuery], *axes: str) -> list[tuple]:
    """Count records by the values of the fields `axes`, as tuples (value, ..., train, test)."""
    counts = Counter((*(getattr(r, axis) for axis in axes), r.split) for r in records)
    keys = dict.fromkeys(key[:-1] for key in counts)
    return [(*key, *(counts[*key, split] for split in SPLITS)) for key in keys]


def _write_record(folder: Path, record: dict[str, Any]) -> None:
    write_bytes(folder / EXPORT_RECORD, json.dumps(record, indent=1).encode())


def _verify(folder: Path, plan: dict[str, Any]) -> list[Shard]:
    """Return the shards of an undamaged export of `plan`."""
    record = read_json_if_valid(folder / EXPORT_RECORD)
    if "shards" not in record:
        raise UserError(
            f"{folder} exists but contains no readable export: choose another folder with "
            "folder=FOLDER",
            code="folder-in-use",
        )
    for key, value in plan.items():
        if record.get(key) != value:
            raise UserError(
                f"{folder} contains an export with {key}={record.get(key)}, not {key}={value}: "
                f"choose another folder with folder=FOLDER, or delete {folder}",
                code="other-settings",
            )
    expected = {CARD: record["card"]} | {s["path"]: s["sha256"] for s in record["shards"]}
    for name, sha256 in expected.items():
        path = folder / name
        problem = "missing" if not path.exists() else "damaged" if hash_file(path) != sha256 else ""
        if problem:
            raise UserError(
                f"{path} is {problem}: delete {folder} and export again", code=f"{problem}-file"
            )
    return record["shards"]


def summarize(shards: Sequence[Shard]) -> pd.DataFrame:
    """Return the rows, size in MB and number of files of each split."""
    import pandas as pd

    splits = pd.DataFrame(shards).groupby(["configuration", "split"], sort=False)
    summary = splits.agg(rows=("rows", "sum"), MB=("bytes", "sum"), files=("path", "size"))
    return summary.assign(MB=summary["MB"] / 1e6)
