"""Makes all items and queries of a benchmark from the oracle alone, one cell after another.

A cell is a subtype of a family of selection items, or a builder, which makes one kind of retrieval
queries. Each is a separate job with its own random generator. A job writes its result to a file
whose name is a hash of the job's inputs. A killed build resumes with the files that exist, and a
build with changed quotas repeats only the jobs whose quotas changed.
"""

from __future__ import annotations

import json
import math
from collections import Counter, defaultdict
from collections.abc import Mapping
from copy import copy
from dataclasses import asdict
from functools import lru_cache, partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np

from dynapix.conf.files import write_bytes
from dynapix.conf.schema import BenchmarkConfig, Quota
from dynapix.conf.schema.benchmark import INTERVENTIONS, MATCHED_ANCHOR
from dynapix.data.items import recipes, transfer
from dynapix.data.items.futures import contact
from dynapix.data.items.futures.balanced import BalancedPicker
from dynapix.data.items.futures.balanced_subset import RESERVE, choose_items
from dynapix.data.items.futures.contact import ContactPicker
from dynapix.data.items.futures.interventions import (
    InterventionPicker,
    make_intervention_pair,
    make_intervention_recipe,
)
from dynapix.data.items.pickers import (
    CellInputs,
    DistractorPicker,
    Recipe,
    fill_quota,
    shuffle_candidates,
)
from dynapix.data.items.queries import make_counterfactual_queries, make_future_queries
from dynapix.data.items.scores import compare_item
from dynapix.data.parallel import Workers
from dynapix.data.records import (
    CONTACT,
    FAMILIES,
    GHOST,
    SPLITS,
    RetrievalQuery,
    Scene,
    SelectionItem,
)
from dynapix.data.seeded_order import named_rng
from dynapix.data.store import PARTS, SCENES_FOLDER, hash_files, load_scene, part_path, scene_path
from dynapix.data.versions import component_versions

COUNTERFACTUAL = "counterfactual"
CACHED_SCENES = 20_000
"""Number of scenes that a worker keeps in memory, at about 50 KB each."""
QUERY_RESERVE = 1.6
"""Factor on the quotas of queries: those with near-duplicate targets are dropped later. In worlds
whose objects come to rest, these are many."""

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
    recipe = cfg.item_recipe, cfg.suite, cfg.distractors
    if cfg.simulator != "bullet":
        # A release may have changed since a killed build, while its scenes keep their ids.
        every = [f"{SCENES_FOLDER}/{name}.npz" for ids in scene_ids.values() for name in ids]
        recipe = *recipe, hash_files(folder, every)
    shared = [component_versions(asdict(cfg)), scene_ids, *recipe, *settings]
    jobs, sizes, paths = {}, {}, {}
    # Largest quotas first, so that no single worker is left with a large job at the end.
    for name, quota in sorted(quotas.items(), key=lambda job: -job[1].train):
        inputs = CellInputs(scene_ids, partial(load_cached, folder), quota, *settings)
        paths[name] = path = part_path(folder, [*shared, name, asdict(quota)])
        jobs[path] = partial(_make_cell, cfg, name, inputs, path)
        sizes[path] = quota.train + quota.test
    if is_balanced(cfg) or cfg.selection.interventions:
        # Alternative futures have the same names for other settings: a result from before a change
        # of settings may refer to futures that were simulated since.
        for path in {*(folder / PARTS).glob("*.json")} - jobs.keys():
            path.unlink()
    workers.write_files(jobs, "making items and queries", "item", sizes)
    items, queries, scores, dropped = [], [], {}, Counter()
    for name in quotas:
        part = json.loads(paths[name].read_bytes())
        if _is_query_cell(name):
            queries += map(RetrievalQuery.from_row, part["rows"])
            dropped["queries dropped, too alike"] += part["dropped"]
        else:
            made = [SelectionItem.from_row(row) for row in part["rows"]]
            items += made
            scores |= zip((i.item_id for i in made), part.get("scores", []), strict=False)
            for reason, count in part["dropped"].items():
                dropped[f"items dropped, {reason}/{name.partition('/')[0]}"] += count
    if is_balanced(cfg):
        items = _choose_balanced(cfg, items, scores)
    return items, queries, dict(dropped)


def _make_cell(cfg: BenchmarkConfig, name: str, inputs: CellInputs, path: Path) -> None:
    """Make the items or queries of one cell, and write them to a file."""
    group, _, subtype = name.partition("/")
    part: dict[str, Any] = {}
    if group == COUNTERFACTUAL:
        made, dropped = make_counterfactual_queries(inputs)
    elif _is_query_cell(group):
        made, dropped = make_future_queries(int(group.split()[1]), inputs)
    elif group == INTERVENTIONS:
        make_picker = partial(InterventionPicker, world=cfg.world, folder=path.parents[1])
        actual, dropped = fill_quota(name, make_intervention_recipe(subtype), inputs, make_picker)
        pairs = (make_intervention_pair(item, inputs.scene_of(item.scene_id)) for item in actual)
        made = [item for pair in pairs for item in pair]
    elif group == MATCHED_ANCHOR:
        by_time, dropped = fill_quota(name, recipes.MATCHED, inputs)
        made = [paired for item in by_time for paired in recipes.make_pair(item)]
    else:
        pickers = {"paper": DistractorPicker, "balanced": BalancedPicker, CONTACT: ContactPicker}
        make_picker = pickers[cfg.distractors]
        if is_balanced(cfg):
            make_picker = partial(make_picker, world=cfg.world, folder=path.parents[1])
        made, dropped = fill_quota(subtype, cell_recipe(cfg, group, subtype), inputs, make_picker)
        if is_balanced(cfg):
            compared = (compare_item(item, inputs.scene_of, asdict(cfg)) for item in made)
            part["scores"] = [each.item_scores().tolist() for each in compared]
    part |= {"rows": [asdict(row) for row in made], "dropped": dropped}
    write_bytes(path, json.dumps(part).encode())


def is_balanced(cfg: BenchmarkConfig) -> bool:
    """Return whether the distractors of a benchmark are simulated, and its items balanced."""
    return cfg.distractors != "paper"


def cell_recipe(cfg: BenchmarkConfig, family: str, subtype: str) -> Recipe:
    """Return the recipe of a cell of a benchmark's suite."""
    if cfg.distractors == CONTACT:
        return contact.make_contact_recipe(subtype)
    if cfg.item_recipe in transfer.CELLS:
        return transfer.make_transfer_recipe(cfg.item_recipe, cfg.suite, family, subtype)
    return recipes.make_recipe(cfg.suite, family, subtype)


def list_subtypes(cfg: BenchmarkConfig) -> Mapping[str, tuple[str, ...]]:
    """Return the subtypes of each family of a benchmark's suite."""
    if cfg.distractors == CONTACT:
        return {"event": (*contact.CELLS,), "time": (), "window": ()}
    own = {"dynapix": recipes.CELLS, "tracks": recipes.CELLS_WITHOUT_CONTACTS}
    return (own | transfer.CELLS)[cfg.item_recipe]


def _choose_balanced(
    cfg: BenchmarkConfig, items: list[SelectionItem], scores: Mapping[str, Any]
) -> list[SelectionItem]:
    """Return the items up to their quotas, chosen so that the scores of their candidates, by item
    id, are even in each family, difficulty and split. Items without scores, such as matched pairs,
    are kept."""
    pools: dict[tuple[str, ...], list[SelectionItem]] = defaultdict(list)
    for item in items:
        if item.item_id in scores:
            kind = item.difficulty or (GHOST if contact.has_ghost(item) else "")
            pools[item.split, item.family, kind].append(item)
    chosen: dict[str, SelectionItem] = {}
    quotas = family_quotas(cfg)
    for (split, family, kind), pool in pools.items():
        rng = named_rng(cfg.seed, "pool", split, family, kind)
        own = np.array([scores[item.item_id] for item in pool])
        order = np.array([contact.order_candidates(item) for item in pool])
        ordered = np.take_along_axis(own, order[:, None], axis=-1)
        wanted = {subtype: getattr(quota, split) for subtype, quota in quotas[family].items()}
        if cfg.distractors == CONTACT:
            wanted = {k: contact.share_of_quota(n, kind == GHOST) for k, n in wanted.items()}
        eligible = contact.eligible_candidates(kind == GHOST)
        kept = choose_items(ordered, [item.subtype for item in pool], wanted, rng, eligible)
        for _, cell in groupby((pool[k] for k in kept), key=lambda item: item.subtype):
            chosen |= {item.item_id: item for item in shuffle_candidates([*cell], rng)}
    return [
        chosen.get(i.item_id, i) for i in items if i.item_id in chosen or i.item_id not in scores
    ]


def family_quotas(cfg: BenchmarkConfig) -> dict[str, dict[str, Quota]]:
    """Return the quotas of selection items by family and subtype."""
    return {family: getattr(cfg.selection, family) for family in FAMILIES}


def cell_quotas(cfg: BenchmarkConfig) -> dict[str, Quota]:
    """Return the quotas above 0 of all cells and builders, by name."""
    quotas = {
        f"{family}/{subtype}": quota
        for family, quotas in family_quotas(cfg).items()
        for subtype, quota in quotas.items()
    }
    interventions = cfg.selection.interventions
    quotas |= {f"{INTERVENTIONS}/{change}": quota for change, quota in interventions.items()}
    quotas[MATCHED_ANCHOR] = cfg.selection.matched
    quotas |= {f"builder {b}": quota for b, quota in cfg.retrieval.builders.items()}
    quotas[COUNTERFACTUAL] = cfg.retrieval.counterfactual
    return {name: quota for name, quota in quotas.items() if quota.train + quota.test}


def split_quotas(cfg: BenchmarkConfig) -> dict[str, int]:
    """Return the quotas of all cells and builders in each split, such as `builder 1/test`."""
    quotas = cell_quotas(cfg).items()
    return {f"{cell}/{split}": getattr(quota, split) for cell, quota in quotas for split in SPLITS}


def builder_name(builder: int | None) -> str:
    """Return the name of a builder in `cell_quotas`; None is the counterfactual builder."""
    return COUNTERFACTUAL if builder is None else f"builder {builder}"


def _with_reserve(cfg: BenchmarkConfig, name: str, quota: Quota) -> Quota:
    """Return how many items or queries a job makes, of which those of the quota are chosen."""
    factor = 1.0
    if _is_query_cell(name):
        factor = QUERY_RESERVE
    elif is_balanced(cfg) and name.partition("/")[0] in FAMILIES:
        factor = RESERVE
    made = copy(quota)
    made.train, made.test = (math.ceil(factor * n) for n in (quota.train, quota.test))
    return made


def _is_query_cell(name: str) -> bool:
    return name == COUNTERFACTUAL or name.startswith("builder ")


def load_cached(folder: Path, scene_id: str) -> Scene:
    """Load a scene of a store or a partial build, and keep it in memory until its file changes."""
    path = scene_path(folder, scene_id)
    return _load(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=CACHED_SCENES)
def _load(path: Path, modified: int) -> Scene:
    return load_scene(path)
