"""Counts of a benchmark's records, and the cells that fall short of their quotas."""

from __future__ import annotations

from collections import Counter

from conf.schema import BenchmarkConfig
from data.records import SPLITS, FrameRef, RetrievalQuery, SelectionItem
from data.store import Store
from data.tracks.build_items import builder_name, cell_quotas
from data.tracks.controls import MATCHED_ANCHOR, pair_items


def count_records(
    scene_ids: dict[str, list[str]],
    items: list[SelectionItem],
    queries: list[RetrievalQuery],
    databases: dict[str, list[FrameRef]],
) -> dict[str, int]:
    """Count scenes, items by family, queries by builder and frames by database."""
    tally = Counter({f"scenes/{split}": len(names) for split, names in scene_ids.items()})
    for i in items:
        track = MATCHED_ANCHOR if i.suite == MATCHED_ANCHOR else "selection"
        tally[f"{track}/{i.family}/{i.split}"] += 1
    tally.update(f"retrieval/{builder_name(q.builder)}/{q.split}" for q in queries)
    tally["retrieval/standard test"] = sum(q.standard for q in queries)
    tally.update({f"database/{name}": len(frames) for name, frames in databases.items()})
    return dict(tally)


def find_shortfalls(
    cfg: BenchmarkConfig,
    items: list[SelectionItem],
    queries: list[RetrievalQuery],
    databases: dict[str, list[FrameRef]],
) -> dict[str, str]:
    """Cells, builders and databases with fewer records than their quotas, as "n of quota"."""
    own = [item for item in items if item.suite != MATCHED_ANCHOR]
    pairs = pair_items([item for item in items if item.suite == MATCHED_ANCHOR])
    counts = Counter(f"{item.family}/{item.subtype}/{item.split}" for item in own)
    counts.update(f"{MATCHED_ANCHOR}/{item.split}" for item, _ in pairs)
    counts.update(f"{builder_name(query.builder)}/{query.split}" for query in queries)
    wanted = {
        f"{cell}/{split}": getattr(quota, split)
        for cell, quota in cell_quotas(cfg).items()
        for split in SPLITS
    }
    track = cfg.retrieval
    sizes = (track.database, track.source, track.counterfactual_source)
    for (name, frames), size in zip(databases.items(), sizes, strict=True):
        counts[f"database/{name}"] = len(frames)
        wanted[f"database/{name}"] = size if frames else 0
    return {
        name: f"{counts[name]} of {quota}" for name, quota in wanted.items() if counts[name] < quota
    }


def summarize_store(store: Store) -> str:
    """A table of a store's counts and shortfalls."""
    lines = [f"{store.folder} ({len(store.manifest['files'])} files, {store.identity})"]
    lines += [f"  {name:<36}{n:>8,}" for name, n in store.manifest["counts"].items()]
    lines += [f"  short: {cell} has {n}" for cell, n in store.manifest["shortfalls"].items()]
    return "\n".join(lines)
