"""Makes all items and queries of a benchmark from the oracle alone.

A cell is a subtype of a family of selection items; a builder is a function that makes one kind of
retrieval queries. Each is a separate job with its own random generator. A job writes its result to
a file whose name is a hash of the job's inputs. A killed build resumes with the files that exist,
and a build with changed quotas repeats only the jobs whose quotas changed.
"""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import asdict, astuple, replace
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from conf.files import write_bytes
from conf.schema import BenchmarkConfig, Quota
from data.parallel import Workers
from data.records import ALTERNATIVE, FAMILIES, RetrievalQuery, Scene, SelectionItem
from data.releases.transfer_suites import TRANSFER_SUITES, suite_name
from data.store import PARTS, SCENES_FOLDER, load_scene, part_path, save_scene, scene_path
from data.tracks.controls import MATCHED_ANCHOR, fill_pairs
from data.tracks.quota import CellInputs, fill_quota, named_rng, shuffle_candidates
from data.tracks.retrieval import counterfactual, future
from data.tracks.selection import event_items, time_items, window_items
from data.tracks.selection.balanced_subset import RESERVE, choose_items
from data.tracks.selection.distractors import BUILDERS_VERSIONS, Family, Timing
from data.tracks.shortcuts import item_scores, order_target_first
from data.world.physics import generator_version

DYNAPIX_FAMILIES = {
    "event": event_items.FAMILY,
    "time": time_items.FAMILY,
    "window": window_items.FAMILY,
}
OBSERVATIONS = ("event", "window")
"""Families whose number of observed frames is a setting."""
COUNTERFACTUAL = "counterfactual"
CACHED_SCENES = 20_000
"""Number of scenes that a worker keeps in memory, at about 50 KB each."""
QUERY_RESERVE = 1.3
"""Factor on the quotas of queries: those with near-duplicate targets are dropped later."""

ScenesOfSplit = dict[str, list[str]]


def make_items_and_queries(
    cfg: BenchmarkConfig, folder: Path, scene_ids: ScenesOfSplit, workers: Workers
) -> tuple[list[SelectionItem], list[RetrievalQuery], dict[str, int]]:
    """Make the items and queries of the scenes below `folder`, in the order of the config.

    Returns:
        The items; the queries, up to `QUERY_RESERVE` times their quotas; and the numbers of items
        and queries that were dropped because no suitable distractors or hard negatives were found.
    """
    quotas = {name: _with_reserve(cfg, name, quota) for name, quota in cell_quotas(cfg).items()}
    settings = cfg.seed, cfg.selection.min_displacement, cfg.retrieval.hard_negatives
    recipe = cfg.distractors, cfg.selection.observation
    version = BUILDERS_VERSIONS[cfg.distractors]
    generator = generator_version(cfg.world.physics.rolling_friction)
    inputs = [generator, version, scene_ids, *recipe, *settings]
    paths = {
        name: part_path(folder, [*inputs, name, asdict(quota)]) for name, quota in quotas.items()
    }
    # Largest quotas first, so that no single worker is left with a large job at the end.
    jobs, sizes = {}, {}
    for name, quota in sorted(quotas.items(), key=lambda job: -job[1].train):
        cell = CellInputs(scene_ids, partial(_load, folder), quota, *settings)
        jobs[paths[name]] = partial(_run_job, cfg, name, cell, paths[name])
        sizes[paths[name]] = quota.train + quota.test
    if cfg.distractors == "balanced":
        remove_other_parts(folder, paths.values())
    workers.write_files(jobs, "making items and queries", "item", sizes)
    items: list[SelectionItem] = []
    scores: dict[str, list[list[list[float]]]] = {}
    queries: list[RetrievalQuery] = []
    dropped: Counter[str] = Counter()
    for name in quotas:
        part = json.loads(paths[name].read_bytes())
        if _is_query_cell(name):
            queries += map(RetrievalQuery.from_row, part["rows"])
            dropped["queries dropped, too alike"] += part["dropped"]
        else:
            made = [SelectionItem.from_row(row) for row in part["rows"]]
            items += made
            scores |= zip((i.item_id for i in made), part.get("scores", []), strict=False)
            reason = "no suitable distractors" if cfg.distractors == "balanced" else "too alike"
            dropped[f"items dropped, {reason}/{name.partition('/')[0]}"] += part["dropped"]
    if cfg.distractors == "balanced":
        items = _choose_balanced(cfg, items, scores)
    return items, queries, dict(dropped)


def _choose_balanced(
    cfg: BenchmarkConfig, items: list[SelectionItem], scores: Mapping[str, Any]
) -> list[SelectionItem]:
    """Return the items up to their quotas, chosen so that their scores are even in each family,
    difficulty and split.

    Args:
        scores: Scores of the candidates by item id. Items without scores, such as matched pairs,
            are kept.
    """
    pools: dict[tuple[str, ...], list[SelectionItem]] = defaultdict(list)
    for item in items:
        if item.item_id in scores:
            pools[item.split, item.family, item.difficulty or ""].append(item)
    chosen: dict[str, SelectionItem] = {}
    quotas = family_quotas(cfg)
    for (split, family, difficulty), pool in pools.items():
        rng = named_rng(cfg.seed, "pool", split, family, difficulty)
        kept = choose_items(
            order_target_first(
                np.array([scores[item.item_id] for item in pool]),
                np.array([item.answer for item in pool]),
            ),
            [item.subtype for item in pool],
            {subtype: getattr(quota, split) for subtype, quota in quotas[family].items()},
            rng,
        )
        for _, cell in groupby((pool[k] for k in kept), key=lambda item: item.subtype):
            chosen |= {item.item_id: item for item in shuffle_candidates([*cell], rng)}
    return [
        chosen.get(i.item_id, i) for i in items if i.item_id in chosen or i.item_id not in scores
    ]


def item_families(cfg: BenchmarkConfig) -> Mapping[str, Family]:
    """Return the families of a benchmark's suite by name."""
    if suite_name(cfg) in TRANSFER_SUITES:
        return TRANSFER_SUITES[suite_name(cfg)]
    lengths = cfg.selection.observation
    return DYNAPIX_FAMILIES | {
        name: _with_observation(DYNAPIX_FAMILIES[name], name, lengths) for name in OBSERVATIONS
    }


def _with_observation(family: Family, name: str, lengths: Mapping[str, int]) -> Family:
    """Return a family whose prefixes have the given numbers of frames, by family or subtype."""

    def timings(subtype: str, scene: Scene) -> list[Timing]:
        length = lengths.get(subtype, lengths.get(name))
        return family.timings(subtype, scene, *([] if length is None else [length]))

    return replace(family, timings=timings)


def family_quotas(cfg: BenchmarkConfig) -> dict[str, dict[str, Quota]]:
    """Return the quotas of selection items by family and subtype."""
    return {family: getattr(cfg.selection, family) for family in FAMILIES}


def cell_quotas(cfg: BenchmarkConfig) -> dict[str, Quota]:
    """Return the quotas of all cells and builders by name."""
    return {
        **{
            f"{family}/{subtype}": quota
            for family, quotas in family_quotas(cfg).items()
            for subtype, quota in quotas.items()
        },
        MATCHED_ANCHOR: cfg.selection.matched,
        **{f"builder {b}": quota for b, quota in cfg.retrieval.builders.items()},
        COUNTERFACTUAL: cfg.retrieval.counterfactual,
    }


def builder_name(builder: int | None) -> str:
    """Return the name of a builder in `cell_quotas`; None is the counterfactual builder."""
    return COUNTERFACTUAL if builder is None else f"builder {builder}"


def _with_reserve(cfg: BenchmarkConfig, name: str, quota: Quota) -> Quota:
    """Return how many items or queries a job makes, of which those of the quota are chosen."""
    factor = 1.0
    if _is_query_cell(name):
        factor = QUERY_RESERVE
    elif cfg.distractors == "balanced" and name != MATCHED_ANCHOR:
        factor = RESERVE
    return Quota(*(math.ceil(factor * n) for n in astuple(quota)))


def _is_query_cell(name: str) -> bool:
    return name == COUNTERFACTUAL or name.startswith("builder ")


@lru_cache(maxsize=CACHED_SCENES)
def _load(folder: Path, scene_id: str) -> Scene:
    return load_scene(scene_path(folder, scene_id))


def _save(folder: Path, scene: Scene) -> None:
    save_scene(scene, scene_path(folder, scene.scene_id))


def remove_unused_futures(folder: Path, items: Iterable[SelectionItem]) -> None:
    """Delete the alternative futures below `folder` to which no item refers, such as those of a
    killed build with other quotas."""
    used = {candidate.scene_id for item in items for candidate in item.candidates}
    for path in (folder / SCENES_FOLDER).glob(f"*{ALTERNATIVE}*.npz"):
        if path.stem not in used:
            path.unlink()


def remove_other_parts(folder: Path, kept: Iterable[Path]) -> None:
    """Delete the results of jobs below `folder` that are not in `kept`.

    The alternative futures of balanced items have the same names for other settings, so that a
    result from before a change of settings may refer to futures that were simulated since.
    """
    for path in {*(folder / PARTS).glob("*.json")} - {*kept}:
        path.unlink()


def _run_job(cfg: BenchmarkConfig, name: str, cell: CellInputs, path: Path) -> None:
    group, _, subtype = name.partition("/")
    part: dict[str, Any] = {}
    if group == MATCHED_ANCHOR:
        made, dropped = fill_pairs(cell)
    elif group == COUNTERFACTUAL:
        made, dropped = counterfactual.make_queries(cell)
    elif _is_query_cell(group):
        made, dropped = future.make_queries(int(group.split()[1]), cell)
    else:
        if cfg.distractors == "balanced":
            cell = replace(cell, world=cfg.world, save=partial(_save, path.parents[1]))
        made, dropped = fill_quota(subtype, item_families(cfg)[group], cell)
        if cfg.distractors == "balanced":
            scene_of = partial(_load, path.parents[1])
            part["scores"] = [item_scores(i, scene_of, asdict(cfg)).tolist() for i in made]
    part |= {"rows": [row.to_row() for row in made], "dropped": dropped}
    write_bytes(path, json.dumps(part).encode())
