"""What a built benchmark holds, cell by cell, and where it fell short of its quotas."""

from __future__ import annotations

from collections import Counter

from conf.schema import BenchmarkConfig
from data.records import SPLITS, FrameRef, RetrievalQuery, SelectionItem
from data.store import Store
from data.tracks.build_items import family_quotas
from data.tracks.controls import MATCHED_ANCHOR


def count_records(
    scene_ids: dict[str, list[str]],
    items: list[SelectionItem],
    queries: list[RetrievalQuery],
    databases: dict[str, list[FrameRef]],
) -> dict[str, int]:
    """Scenes, items by family, queries by builder and frames by database."""
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
    """What every cell, builder and database has, where that is less than its quota."""
    found = Counter(
        (f"{i.family}/{i.subtype}", i.split) for i in items if i.suite != MATCHED_ANCHOR
    )
    # A pair is two items.
    found.update(
        (MATCHED_ANCHOR, i.split) for i in items if i.suite == MATCHED_ANCHOR and i.family == "time"
    )
    found.update((_builder(q), q.split) for q in queries)
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
        f"{cell}/{split}": f"{found[cell, split]} of {getattr(quota, split)}"
        for cell, quota in wanted.items()
        for split in SPLITS
        if found[cell, split] < getattr(quota, split)
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
    """What a store holds and where it fell short, as a small table."""
    lines = [f"{store.folder} ({len(store.manifest['files'])} files, {store.identity})"]
    lines += [f"  {name:<36}{many:>8,}" for name, many in store.manifest["counts"].items()]
    for cell, found in store.manifest["shortfalls"].items():
        lines.append(f"  short: {cell} has {found}")
    return "\n".join(lines)
