"""Counts of a benchmark's records, and the cells with fewer records than their quotas."""

from __future__ import annotations

from collections import Counter

from dynapix.conf.schema import BenchmarkConfig
from dynapix.conf.schema.benchmark import INTERVENTIONS, MATCHED_ANCHOR, PAIRED
from dynapix.data.items.cells import builder_name, split_quotas
from dynapix.data.records import CONTACT, SPLITS, FrameRef, RetrievalQuery, SelectionItem
from dynapix.data.store import Store


def count_records(
    cfg: BenchmarkConfig,
    scene_ids: dict[str, list[str]],
    items: list[SelectionItem],
    queries: list[RetrievalQuery],
    databases: dict[str, list[FrameRef]],
) -> tuple[dict[str, int], dict[str, str]]:
    """Count a benchmark's records.

    Returns:
        Counts of scenes, items by family, queries by builder and frames by database; and a text
        "n of quota" for each cell, builder and database with fewer records than its quota.
    """
    counts = Counter({f"scenes/{split}": len(names) for split, names in scene_ids.items()})
    cells: Counter[str] = Counter()
    for item in items:
        is_own = item.suite not in PAIRED
        track = "selection" if is_own else item.suite
        counts[f"{track}/{item.family}/{item.split}"] += 1
        if item.suite == INTERVENTIONS:
            # A quota counts pairs.
            cells[f"{INTERVENTIONS}/{item.subtype}/{item.split}"] += item.framing == "future"
        cells[f"{item.family}/{item.subtype}/{item.split}"] += is_own
    for split in SPLITS:
        cells[f"{MATCHED_ANCHOR}/{split}"] = counts[f"{MATCHED_ANCHOR}/event/{split}"]
    cells.update(f"{builder_name(query.builder)}/{query.split}" for query in queries)
    counts.update(f"retrieval/{builder_name(query.builder)}/{query.split}" for query in queries)
    counts["retrieval/standard test"] = sum(
        query.pool == "future" and query.split == "test" for query in queries
    )
    quotas = split_quotas(cfg)
    if cfg.test_scenes is not None:
        cells["scenes/test"], quotas["scenes/test"] = len(scene_ids["test"]), cfg.test_scenes
    track = cfg.retrieval
    sizes = (track.database, track.source, track.counterfactual_source)
    for (name, frames), size in zip(databases.items(), sizes, strict=True):
        counts[f"database/{name}"] = cells[f"database/{name}"] = len(frames)
        quotas[f"database/{name}"] = size if frames else 0
    shortfalls = {
        name: f"{cells[name]} of {quota}" for name, quota in quotas.items() if cells[name] < quota
    }
    return dict(counts), shortfalls


def summarize_store(store: Store) -> str:
    """Format a store's counts and shortfalls as a table."""
    lines = [f"{store.folder} ({len(store.manifest['files'])} files, {store.identity})"]
    lines += [f"  {name:<36}{n:>8,}" for name, n in store.manifest["counts"].items()]
    shortfalls = store.manifest["shortfalls"]
    lines += [f"  short: {cell} has {n}" for cell, n in shortfalls.items()]
    if shortfalls:
        lines.append(
            "  to fill them, raise benchmark.scenes, or lower their quotas or "
            "benchmark.selection.min_displacement"
        )
        if store.manifest["config"]["distractors"] == CONTACT:
            lines[-1] += (
                "; if many scenes have no collision after a prefix, raise "
                "benchmark.world.start.distance or start.speed"
            )
    return "\n".join(lines)
