"""The dataset card of an export: its contents, how to load it, how it was built, and its limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from importlib.resources import files
from typing import TYPE_CHECKING

from omegaconf import OmegaConf

from data.publish.columns import DESCRIPTIONS, list_columns
from data.records import POOLS, SPLITS, RetrievalQuery, SelectionItem
from data.store import Store, component_versions

if TYPE_CHECKING:
    from data.publish.huggingface import Shard

SIZES = {1e3: "n<1K", 1e4: "1K<n<10K", 1e5: "10K<n<100K", 1e6: "100K<n<1M"}
"""The Hub's words for fewer rows than these numbers."""


def render_card(store: Store, shards: Sequence[Shard], images: bool) -> str:
    """Return the README.md of an export that was written as `shards`."""
    from jinja2 import Template

    settings = store.manifest["config"]
    rows: dict[str, Counter[str]] = {}
    for shard in shards:
        rows.setdefault(shard["configuration"], Counter())[shard["split"]] += shard["rows"]
    total = sum(shard["rows"] for shard in shards)
    items = store.selection()
    queries = [q for pool in POOLS for q in store.retrieval(pool=pool)]
    text = (files("data.publish") / "templates/dataset_card.md").read_text()
    return Template(text).render(
        store=store,
        images=images,
        size=next((name for size, name in SIZES.items() if total < size), "1M<n<10M"),
        scene=store.scene(store.scene_ids("test")[0]),
        scenes={split: len(store.scene_ids(split)) for split in SPLITS},
        families=count_rows(items, "family"),
        subtypes=count_rows(items, "family", "subtype"),
        queries=count_rows(queries, "pool", "builder", "anchor"),
        rows=rows,
        columns=list_columns(images),
        descriptions=DESCRIPTIONS,
        versions=component_versions(
            settings["simulator"], settings["renderer"], settings.get("standin")
        ),
        settings=OmegaConf.to_yaml(OmegaConf.create(settings)),
    )


def count_rows(records: Iterable[SelectionItem | RetrievalQuery], *axes: str) -> list[tuple]:
    """Count records by the values of some fields: a tuple (value, ..., train, test) for each."""
    counts = Counter((*(getattr(r, axis) for axis in axes), r.split) for r in records)
    keys = dict.fromkeys(key[:-1] for key in counts)
    return [(*key, *(counts[*key, split] for split in SPLITS)) for key in keys]
