"""The dataset card of an export: its contents, how to load it, how it was built, and its limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from importlib.resources import files
from typing import TYPE_CHECKING

from omegaconf import OmegaConf

from data.publish.columns import DESCRIPTIONS
from data.records import POOLS, SPLITS, RetrievalQuery, SelectionItem
from data.store import Store, component_versions

if TYPE_CHECKING:
    from datasets import Features
    from huggingface_hub import DatasetCardData

    from data.publish.huggingface import Shard

TEMPLATE = "templates/dataset_card.md"
SIZES = {1e3: "n<1K", 1e4: "1K<n<10K", 1e5: "10K<n<100K", 1e6: "100K<n<1M"}


def render_card(
    store: Store, columns: dict[str, Features], shards: Sequence[Shard], images: bool
) -> str:
    """Return the README.md of an export that was written as `shards`."""
    from huggingface_hub import DatasetCard

    settings = store.manifest["config"]
    configurations: dict[str, list[str]] = {}
    databases: Counter[str] = Counter()
    for shard in shards:
        splits = configurations.setdefault(shard.configuration, [])
        if shard.split not in splits:
            splits.append(shard.split)
        if shard.configuration == "database":
            databases[shard.split] += shard.rows
    items = store.selection()
    queries = [q for pool in POOLS for q in store.retrieval(pool=pool)]
    return DatasetCard.from_template(
        card_metadata(columns, shards, configurations),
        template_str=(files("data.publish") / TEMPLATE).read_text(),
        store=store,
        images=images,
        scene=store.scene(store.scene_ids("test")[0]),
        scenes={split: len(store.scene_ids(split)) for split in SPLITS},
        families=count_rows(items, "family"),
        subtypes=count_rows(items, "family", "subtype"),
        queries=count_rows(queries, "pool", "builder", "anchor"),
        databases=databases,
        configurations=configurations,
        descriptions={
            name: {column: DESCRIPTIONS[column] for column in columns[name]}
            for name in configurations
        },
        versions=component_versions(
            settings["simulator"], settings["renderer"], settings.get("standin")
        ),
        settings=OmegaConf.to_yaml(OmegaConf.create(settings)),
    ).content


def count_rows(records: Iterable[SelectionItem | RetrievalQuery], *axes: str) -> list[tuple]:
    """Count records by the values of some fields: a tuple (value, ..., train, test) for each."""
    counts = Counter((*(getattr(r, axis) for axis in axes), r.split) for r in records)
    keys = dict.fromkeys(key[:-1] for key in counts)
    return [(*key, *(counts[*key, split] for split in SPLITS)) for key in keys]


def card_metadata(
    columns: dict[str, Features], shards: Sequence[Shard], configurations: dict[str, list[str]]
) -> DatasetCardData:
    """Return the card's YAML header: licence, sizes, and the files and columns of each split."""
    from datasets import DatasetInfo, SplitDict, SplitInfo
    from datasets.info import DatasetInfosDict
    from huggingface_hub import DatasetCardData

    infos = DatasetInfosDict()
    for name, splits in configurations.items():
        mine = [s for s in shards if s.configuration == name]
        sizes = {split: SplitInfo(split, num_bytes=0, num_examples=0) for split in splits}
        for shard in mine:
            sizes[shard.split].num_bytes += shard.uncompressed
            sizes[shard.split].num_examples += shard.rows
        infos[name] = DatasetInfo(
            features=columns[name],
            splits=SplitDict(sizes),
            download_size=sum(s.bytes for s in mine),
            dataset_size=sum(s.uncompressed for s in mine),
        )
    rows = sum(s.rows for s in shards)
    data = DatasetCardData(
        license="apache-2.0",
        language="en",
        pretty_name="DynaPix",
        task_categories=["visual-question-answering", "multiple-choice"],
        size_categories=next((name for size, name in SIZES.items() if rows < size), "1M<n<10M"),
        annotations_creators="machine-generated",
        source_datasets=["original"],
        tags=["physics", "simulation", "video", "future-frame-selection", "image-retrieval"],
        configs=[
            {
                "config_name": name,
                "data_files": [{"split": s, "path": f"{name}/{s}-*.parquet"} for s in splits],
                **({"default": True} if k == 0 else {}),
            }
            for k, (name, splits) in enumerate(configurations.items())
        ],
    )
    infos.to_dataset_card_data(data)
    return data
