"""Write benchmarks as a Hugging Face dataset, which can be loaded without this repository.

    <folder>/README.md      the dataset card, which names the files of each split
             eval.yaml      the task of inspect_ai for a leaderboard on the hub
             export.json    the exported benchmarks' identities, and the SHA-256 of every file
             <configuration>/<split>-00000-of-00002.parquet

The configurations of a benchmark are its tables: selection, matched_anchor, interventions,
retrieval, database, leaderboard and rationales, as far as it has them. In a dataset of several
benchmarks, their names begin with that of their benchmark, such as tiny-selection.

A killed export resumes with the shards that it has written (see `data.publish.folders`).
"""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import OmegaConf
from tqdm import tqdm

from dynapix.conf.files import write_bytes
from dynapix.conf.schema.benchmark import PAIRED, POOLS
from dynapix.data.publish.columns import (
    DESCRIPTIONS,
    LEADERBOARD,
    ExportedRecord,
    RowBuilder,
    arrow_schema,
    list_columns,
)
from dynapix.data.publish.folders import Shard, describe_file, write_folder
from dynapix.data.publish.leaderboard import EVAL_FILE, write_eval_file
from dynapix.data.records import SPLITS, RetrievalQuery, SelectionItem
from dynapix.data.store import DATABASES, Store
from dynapix.data.versions import component_versions

if TYPE_CHECKING:
    import pandas as pd

CARD = "README.md"
EXPORT_VERSION = "6"
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


def ensure_export(stores: Mapping[str, Store], folder: Path, images: bool) -> list[Shard]:
    """Export stores to `folder` unless that is already done, and return the shards.

    Args:
        stores: The benchmarks by name.

    Raises:
        UserError: `folder` contains something else or a damaged export, or another process is
            writing to it.
    """
    tables = list_tables(stores, images)
    leaderboards = [table.configuration for table in tables if table.kind == LEADERBOARD]
    plan = {
        "benchmarks": {name: store.identity for name, store in stores.items()},
        "rationales": digest_rationales(tables),
        "version": EXPORT_VERSION,
        "images": images,
    }

    def write(unfinished: Path) -> list[Shard]:
        shards: list[Shard] = []
        builders = {name: RowBuilder(store, images) for name, store in stores.items()}
        rows = sum(len(table.records) for table in tables)
        with tqdm(total=rows, desc="exporting", unit="row", mininterval=1.0) as bar:
            for table in tables:
                shards += _write_table(unfinished, table, builders[table.benchmark], bar)
        write_bytes(unfinished / CARD, render_card(stores, shards, images).encode())
        if leaderboards:
            write_bytes(unfinished / EVAL_FILE, write_eval_file(leaderboards))
        return shards

    return write_folder(folder, plan, write, [CARD, *([EVAL_FILE] if leaderboards else [])])


@dataclass(frozen=True)
class ExportedTable:
    """A split of a table.

    Attributes:
        benchmark: Name of the benchmark.
        kind: Name of the table, such as selection.
        configuration: Name of the table in the dataset: `kind`, or with the benchmark's name.
        split: train or test; for the frames of a database, its name.
    """

    benchmark: str
    kind: str
    configuration: str
    split: str
    records: Sequence[ExportedRecord]


def list_tables(stores: Mapping[str, Store], images: bool) -> list[ExportedTable]:
    """Return the tables of benchmarks that are not empty; the leaderboards need `images`."""
    tables = []
    for benchmark, store in stores.items():
        prefix = f"{benchmark}-" if len(stores) > 1 else ""
        tables += [
            ExportedTable(benchmark, kind, prefix + kind, split, records)
            for (kind, split), records in _list_records(store).items()
            if records and (images or kind != LEADERBOARD)
        ]
    return tables


def _list_records(store: Store) -> dict[tuple[str, str], list[ExportedRecord]]:
    """Return the records of a benchmark by table and split."""
    records: dict[tuple[str, str], list[ExportedRecord]] = {}
    for kind, suite in {"selection": None, **{suite: suite for suite in PAIRED}}.items():
        for split in SPLITS:
            records[kind, split] = [*store.selection(split, suite)]
    for split in SPLITS:
        queries = [q for pool in POOLS for q in store.retrieval(split, pool)]
        records["retrieval", split] = [*queries]
    records[LEADERBOARD, "test"] = [*store.selection("test")]
    records |= {("database", name): [*store.database(name)] for name in DATABASES}
    # Rationales are written for training items.
    return records | {("rationales", "train"): [*store.rationales()]}


def digest_rationales(tables: Iterable[ExportedTable]) -> str | None:
    """Return a short hash of all rationales, which a later narration replaces; None if there are
    none."""
    records = [r for table in tables if table.kind == "rationales" for r in table.records]
    content = json.dumps([asdict(record) for record in records]).encode()
    return hashlib.sha256(content).hexdigest()[:16] if records else None


def _write_table(
    folder: Path, table: ExportedTable, builder: RowBuilder, bar: tqdm
) -> Iterator[Shard]:
    """Write the missing shards of a table, and yield each of its shards."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    schema = arrow_schema(table.kind, builder.images)
    images, records = builder.images_per_row(table.kind), table.records
    group = max(1, GROUP_IMAGES // images) if images else GROUP_ROWS
    size = group * SHARD_GROUPS
    count = -(-len(records) // size)
    for k in range(count):
        path = folder / table.configuration / f"{table.split}-{k:05d}-of-{count:05d}.parquet"
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
                    rows = [
                        builder.row(r, table.kind, table.split) for r in part[start : start + group]
                    ]
                    writer.write_table(pa.Table.from_pylist(rows, schema))
                    bar.update(len(rows))
            os.replace(unfinished, path)
        labels = {"configuration": table.configuration, "split": table.split, "rows": len(part)}
        yield labels | describe_file(folder, path)


def render_card(stores: Mapping[str, Store], shards: Sequence[Shard], images: bool) -> str:
    """Return the dataset card (README.md) of an export with these shards."""
    from jinja2 import Template

    rows: dict[str, Counter[str]] = {}
    for shard in shards:
        rows.setdefault(shard["configuration"], Counter())[shard["split"]] += shard["rows"]
    kinds = {t.configuration: t.kind for t in list_tables(stores, images)}
    columns, shown = list_columns(images), dict.fromkeys(kinds[name] for name in rows)
    text = (files("dynapix.data.publish") / "templates/dataset_card.md").read_text()
    benchmarks = [_describe_benchmark(name, store) for name, store in stores.items()]
    licences = {each["origin"]["license"] for each in benchmarks}
    return Template(text).render(
        benchmarks=benchmarks,
        licence=licences.pop() if len(licences) == 1 else "other",
        is_simulated=all(each["is_simulated"] for each in benchmarks),
        images=images,
        rows=rows,
        columns={kind: columns[kind] for kind in shown},
        descriptions=DESCRIPTIONS,
    )


def _describe_benchmark(name: str, store: Store) -> dict[str, Any]:
    """Return what the card says of a benchmark."""
    # The folder of a release is that of the machine on which the benchmark was built.
    settings = store.manifest["config"] | {"folder": None}
    items = [i for suite in (None, *PAIRED) for i in store.selection(suite=suite)]
    queries = [q for pool in POOLS for q in store.retrieval(pool=pool)]
    return {
        "name": name,
        "store": store,
        "scene": store.scene(store.scene_ids("test")[0]),
        "scenes": {split: len(store.scene_ids(split)) for split in SPLITS},
        "origin": ORIGINS[settings["simulator"]],
        "is_simulated": settings["simulator"] == "bullet",
        "families": _count_rows(items, "suite", "family"),
        "subtypes": _count_rows(items, "suite", "family", "subtype"),
        "queries": _count_rows(queries, "pool", "builder", "anchor"),
        "databases": {name: len(store.database(name)) for name in DATABASES},
        "versions": component_versions(settings),
        "settings": OmegaConf.to_yaml(OmegaConf.create(settings)),
    }


def _count_rows(records: Iterable[SelectionItem | RetrievalQuery], *axes: str) -> list[tuple]:
    """Count records by the values of the fields `axes`, as tuples (value, ..., train, test)."""
    counts = Counter((*(getattr(r, axis) for axis in axes), r.split) for r in records)
    keys = dict.fromkeys(key[:-1] for key in counts)
    return [(*key, *(counts[*key, split] for split in SPLITS)) for key in keys]


def summarize(shards: Sequence[Shard]) -> pd.DataFrame:
    """Return the rows, size in MB and number of files of each split."""
    import pandas as pd

    splits = pd.DataFrame(shards).groupby(["configuration", "split"], sort=False)
    summary = splits.agg(rows=("rows", "sum"), MB=("bytes", "sum"), files=("path", "size"))
    return summary.assign(MB=summary["MB"] / 1e6)
