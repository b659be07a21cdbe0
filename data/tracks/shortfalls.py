"""Counts of a benchmark's records, and the cells that fall short of their quotas."""

from __future__ import annotations

from collections import Counter

from conf.schema import BenchmarkConfig
from data.records import SPLITS, FrameRef, RetrievalQuery, SelectionItem
from data.store import Store
from data.tracks.build_items import family_quotas
from data.tracks.controls import MATCHED_ANCHOR, pair_items


def count_records(
    scene_ids: dict[str, list[str]],
    items: list[SelectionItem],
    queries: list[RetrievalQuery],
    databases: dict[str, list[FrameRef]],
) -> dict[str, int]:
    """Count scenes, items by family, queries by builder and frames by database."""
    tally = Counter({f"scenes/{split}": len(names) for split, names in scene_ids.items()})
    tally.update(f"{_track(i)}/{i.family}/{i.split}" for i in items)
    tally.update(f"retrieval/{_builder(q)}/{q.split}" for q in queries)
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
    counts = Counter((f"{item.family}/{item.subtype}", item.split) for item in own)
    counts.update((MATCHED_ANCHOR, item.split) for item, _ in pairs)
    counts.update((_builder(query), query.split) for query in queries)
    wanted = {
        **{
            f"{family}/{cell}": quota
            for family, quotas in family_quotas(cfg).items()
            for cell, quota in quotas.items()
        },
        MATCHED_ANCHOR: cfg.selection.matched,
        **{f"builder {b}": quota for b, quota in cfg.retrieval.builders.items()},
        "counterfactual": cfg.retrieval.counterfactual,
    }
    short = {
        f"{cell}/{split}": f"{counts[cell, split]} of {getattr(quota, split)}"
        for cell, quota in wanted.items()
        for split in SPLITS
        if counts[cell, split] < getattr(quota, split)
    }
    track = cfg.retrieval
    sizes = {
        "test": track.database,
        "future": track.source,
        "counterfactual": track.counterfactual_source,
    }
    for name, frames in databases.items():
        if 0 < len(frames) < sizes[name]:
            short[f"database/{name}"] = f"{len(frames)} of {sizes[name]}"
    return short


def _track(item: SelectionItem) -> str:
    return MATCHED_ANCHOR if item.suite == MATCHED_ANCHOR else "selection"


def _builder(query: RetrievalQuery) -> str:
    return "counterfactual" if query.builder is None else f"builder {query.builder}"


def summarize_store(store: Store) -> str:
    """A table of a store's counts and shortfalls."""
    lines = [f"{store.folder} ({len(store.manifest['files'])} files, {store.identity})"]
    lines += [f"  {name:<36}{n:>8,}" for name, n in store.manifest["counts"].items()]
    lines += [f"  short: {cell} has {n}" for cell, n in store.manifest["shortfalls"].items()]
    return "\n".join(lines)
