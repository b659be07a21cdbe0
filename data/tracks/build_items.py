"""Every item and query of a benchmark, from the oracle alone.

Each cell of the selection track and each builder of the retrieval track is a job of its own with a
random generator of its own. What it gives is kept in a part that is named by everything it depends
on, so that a killed build goes on with the parts it has, and one whose quotas were changed makes
only the cells that changed.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from conf.schema import BenchmarkConfig, Quota
from data.parallel import Workers
from data.records import RetrievalQuery, Scene, SelectionItem
from data.releases import transfer_suites as transfer
from data.store import PARTS, load_scene, scene_path, write_atomically
from data.tracks.controls import MATCHED_ANCHOR, fill_pairs
from data.tracks.retrieval import counterfactual, future
from data.tracks.selection import distractors, event, time, window
from data.world.physics import GENERATOR_VERSION

RECIPES = {"event": event, "time": time, "window": window}
SCENES_KEPT = 20_000
"""Scenes that a worker keeps in memory, at about 50 KB each."""
RESERVE = 1.3
"""Queries that are made for one that is wanted: some are dropped when databases are made, for their
target looks like another's."""

ScenesOfSplit = dict[str, list[str]]


def make_items_and_queries(
    cfg: BenchmarkConfig, folder: Path, scene_ids: ScenesOfSplit, workers: Workers
) -> tuple[list[SelectionItem], list[RetrievalQuery], dict[str, int]]:
    """Items and queries of the scenes below `folder`, cell by cell in the config's order, and how
    many were dropped for want of distractors that can be told apart. There are more queries than
    the quotas ask for; see `RESERVE`."""
    cells = _cells(cfg)
    paths = {name: _part(folder, cfg, scene_ids, name, quota) for name, quota in cells.items()}
    # The largest cells first, or the last of them would keep a single worker busy at the end.
    jobs = {
        name: partial(_make_cell, cfg, folder, scene_ids, name, quota, paths[name])
        for name, quota in sorted(cells.items(), key=lambda cell: -cell[1].train)
        if not paths[name].exists()
    }
    done = len(cells) - len(jobs)
    for _ in workers.run(jobs, "making items and queries", "cell", done):
        pass
    items: list[SelectionItem] = []
    queries: list[RetrievalQuery] = []
    dropped: Counter[str] = Counter()
    for name in cells:
        part = json.loads(paths[name].read_bytes())
        track, group, _ = name.split("/")
        if track == "retrieval":
            queries += map(RetrievalQuery.from_row, part["rows"])
            dropped["queries dropped, too alike"] += part["dropped"]
        else:
            items += map(SelectionItem.from_row, part["rows"])
            dropped[f"items dropped, too alike/{group}"] += part["dropped"]
    return items, queries, dict(dropped)


def item_builders(cfg: BenchmarkConfig) -> Mapping[str, Any]:
    """How the items of a benchmark's suite are made, by family: each has `CELLS` and `draft`."""
    return transfer.TRANSFER_SUITES.get(suite_name(cfg), RECIPES)


def suite_name(cfg: BenchmarkConfig) -> str:
    """What the benchmark's items belong to."""
    if cfg.standin is not None:
        return f"standin_{cfg.standin}"
    return cfg.simulator if cfg.simulator in transfer.TRANSFER_SUITES else "dynapix"


def family_quotas(cfg: BenchmarkConfig) -> dict[str, dict[str, Quota]]:
    """The selection track's quotas by family and subtype."""
    track = cfg.selection
    return {"event": track.event, "time": track.time, "window": track.window}


def _cells(cfg: BenchmarkConfig) -> dict[str, Quota]:
    """Quotas by track/group/cell."""
    return {
        **{
            f"selection/{family}/{subtype}": quota
            for family, quotas in family_quotas(cfg).items()
            for subtype, quota in quotas.items()
        },
        f"controls/{MATCHED_ANCHOR}/pairs": cfg.selection.matched,
        **{f"retrieval/future/{b}": _more(quota) for b, quota in cfg.retrieval.builders.items()},
        "retrieval/counterfactual/all": _more(cfg.retrieval.counterfactual),
    }


def _more(quota: Quota) -> Quota:
    return Quota(math.ceil(RESERVE * quota.train), math.ceil(RESERVE * quota.test))


def _part(
    folder: Path, cfg: BenchmarkConfig, scene_ids: ScenesOfSplit, name: str, quota: Quota
) -> Path:
    depends = {
        "versions": [GENERATOR_VERSION, distractors.BUILDERS_VERSION],
        "seed": cfg.seed,
        "scenes": scene_ids,
        "cell": name,
        "quota": asdict(quota),
        "least": cfg.selection.min_displacement,
        "hard negatives": cfg.retrieval.hard_negatives,
    }
    key = hashlib.sha256(json.dumps(depends).encode()).hexdigest()
    return folder / PARTS / f"{key[:32]}.json"


_load = lru_cache(maxsize=SCENES_KEPT)(load_scene)


def _make_cell(
    cfg: BenchmarkConfig,
    folder: Path,
    scene_ids: ScenesOfSplit,
    name: str,
    quota: Quota,
    path: Path,
) -> None:
    def scene_of(scene_id: str) -> Scene:
        return _load(scene_path(folder, scene_id))

    track, group, cell = name.split("/")
    least = cfg.selection.min_displacement
    if track == "selection":
        draw = partial(item_builders(cfg)[group].draft, cell)
        found, dropped = distractors.fill(cell, draw, scene_ids, scene_of, quota, cfg.seed, least)
    elif track == "controls":
        found, dropped = fill_pairs(scene_ids, scene_of, quota, cfg.seed, least)
    else:
        shared = (scene_ids, scene_of, quota, cfg.retrieval.hard_negatives, least, cfg.seed)
        found, dropped = (
            future.fill(int(cell), *shared) if group == "future" else counterfactual.fill(*shared)
        )
    part: dict[str, Any] = {"rows": [made.to_row() for made in found], "dropped": dropped}
    write_atomically(path, json.dumps(part).encode())
